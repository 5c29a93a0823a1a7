// SPDX-License-Identifier: MIT
#include "ajna/base/atomic_file.hpp"

#include <fcntl.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstring>
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
  // The process id and a counter keep parallel writers apart; the extension stays, because encoders choose by it.
  const fs::path temporary = folder / ("." + target.stem().string() + ".tmp" + std::to_string(::getpid()) + "-" +
                                       std::to_string(counter++) + target.extension().string());
  // Creating it first tells an unwritable folder from all that may go wrong later; only the attempt itself is reliable
  // (access() lies about read-only and virtual file systems).
  const int descriptor = ::open(temporary.c_str(), O_CREAT | O_EXCL | O_WRONLY | O_CLOEXEC, 0666);
  if (descriptor < 0) {
    throw_runtime("folder '" + folder.string() + "' is not writable (" + std::strerror(errno) +
                  "): choose another one or change its permissions");
  }
  ::close(descriptor);
  try {
    write(temporary.string());
    std::error_code failure;
    fs::rename(temporary, target, failure);
    if (failure) {
      throw_runtime("file '" + path + "' cannot be replaced (" + failure.message() + "): choose another name");
    }
  } catch (...) {
    fs::remove(temporary, ignored);
    throw;
  }
}

}  // namespace ajna
