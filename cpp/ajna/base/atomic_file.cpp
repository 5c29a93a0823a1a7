// SPDX-License-Identifier: MIT
#include "ajna/base/atomic_file.hpp"

#include <unistd.h>

#include <atomic>
#include <filesystem>
#include <system_error>

#include "ajna/base/error.hpp"

namespace ajna {
namespace fs = std::filesystem;

void write_atomically(const std::string& path, const std::function<void(const std::string& temporary)>& write) {
  static std::atomic<unsigned> counter{0};
  const fs::path target(path);
  std::error_code ignored;
  if (path.empty() || !target.has_filename() || fs::is_directory(target, ignored)) {
    throw_invalid("output file '" + path + "' is a folder: give a file name");
  }
  const fs::path folder = target.has_parent_path() ? target.parent_path() : fs::path(".");
  if (!fs::exists(folder, ignored)) {
    throw_not_found(folder.string(), "create this folder before writing '" + target.filename().string() + "'");
  }
  if (!fs::is_directory(folder, ignored)) {
    throw_invalid("output file '" + path + "' lies below '" + folder.string() +
                  "', which is not a folder: give a folder");
  }
  if (::access(folder.c_str(), W_OK | X_OK) != 0) {
    throw_runtime("folder '" + folder.string() + "' cannot be written: choose another one or change its permissions");
  }
  // The process id and a counter keep parallel writers apart; the extension stays, because encoders choose by it.
  const fs::path temporary = folder / ("." + target.stem().string() + ".tmp" + std::to_string(::getpid()) + "-" +
                                       std::to_string(counter++) + target.extension().string());
  try {
    write(temporary.string());
    std::error_code failure;
    fs::rename(temporary, target, failure);
    if (failure) {
      throw_runtime("file '" + path + "' cannot be replaced: " + failure.message());
    }
  } catch (...) {
    fs::remove(temporary, ignored);
    throw;
  }
}

}  // namespace ajna
