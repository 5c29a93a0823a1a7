// SPDX-License-Identifier: MIT
#include "ajna/base/atomic_file.hpp"

#include <fcntl.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdio>
#include <string>
#include <system_error>
#include <utility>

#include "ajna/base/descriptor.hpp"
#include "ajna/base/error.hpp"

namespace ajna {
namespace fs = std::filesystem;
namespace {

std::string reason(int error) { return std::system_category().message(error); }

}  // namespace

AtomicFile::AtomicFile(fs::path path) : path_(std::move(path)) {
  static std::atomic<unsigned> counter{0};
  const std::string name = path_.string();
  if (path_.filename().empty() || path_.filename() == "." || path_.filename() == "..") {
    throw_invalid("output '" + name + "' names no file: give a file name");
  }
  std::error_code ignored;
  if (fs::is_directory(path_, ignored)) {
    throw_invalid("output '" + name + "' is a folder: give a file name");
  }
  const fs::path folder = path_.has_parent_path() ? path_.parent_path() : fs::path(".");
  for (int attempt = 0; attempt < 100; ++attempt) {
    std::string hidden(".");  // grown step by step: GCC 12 warns wrongly about "." + std::string (its bug 105651)
    hidden += path_.stem().string() + ".tmp-" + std::to_string(::getpid()) + "-" +
              std::to_string(counter.fetch_add(1)) + path_.extension().string();
    fs::path candidate = folder / hidden;
    const Descriptor file(::open(candidate.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666));
    if (file.get() >= 0) {
      temporary_ = std::move(candidate);
      return;
    }
    const int error = errno;
    if (error == EEXIST) {
      continue;  // a leftover of a killed process with our id
    }
    if (error == ENOENT && !fs::is_directory(folder, ignored)) {  // /proc says ENOENT, too
      throw_not_found(folder.string(), "create the output folder first");
    }
    if (error == ENOTDIR) {
      throw_invalid("output folder '" + folder.string() + "' is not a folder: choose another");
    }
    throw_runtime("output folder '" + folder.string() + "' is not writable (" + reason(error) +
                  "): choose another or change its permissions");
  }
  throw_runtime("output folder '" + folder.string() + "' is full of temporary files of '" + name + "': remove them");
}

AtomicFile::~AtomicFile() {
  if (!committed_ && !temporary_.empty()) {
    ::unlink(temporary_.c_str());
  }
}

void AtomicFile::write(const void* data, std::size_t size) {
  const Descriptor file(::open(temporary_.c_str(), O_WRONLY | O_TRUNC | O_CLOEXEC));
  std::size_t done = 0;
  while (file.get() >= 0 && done < size) {
    const ssize_t put = ::write(file.get(), static_cast<const char*>(data) + done, size - done);
    if (put < 0 && errno == EINTR) {
      continue;
    }
    if (put < 0) {
      break;
    }
    done += static_cast<std::size_t>(put);
  }
  if (file.get() < 0 || done < size) {
    throw_runtime("file '" + path_.string() + "' cannot be written (" + reason(errno) +
                  "): free space on the disk or choose another folder");
  }
}

void AtomicFile::commit() {
  {
    const Descriptor file(::open(temporary_.c_str(), O_RDONLY | O_CLOEXEC));
    // EINVAL: the file system has no such operation (some network mounts); the rename is still atomic.
    if (file.get() < 0 || (::fsync(file.get()) != 0 && errno != EINVAL && errno != ENOSYS)) {
      throw_runtime("file '" + path_.string() + "' cannot be flushed to the disk (" + reason(errno) +
                    "): free space on the disk or choose another folder");
    }
  }
  if (::rename(temporary_.c_str(), path_.c_str()) != 0) {
    throw_runtime("file '" + path_.string() + "' cannot be put in place (" + reason(errno) +
                  "): choose another output path");
  }
  committed_ = true;
}

void write_file_atomically(const fs::path& path, const void* data, std::size_t size) {
  AtomicFile file(path);
  file.write(data, size);
  file.commit();
}

void write_atomically(const fs::path& path, const std::function<void(const std::string& temporary)>& write) {
  AtomicFile file(path);
  write(file.temporary().string());
  file.commit();
}

}  // namespace ajna
