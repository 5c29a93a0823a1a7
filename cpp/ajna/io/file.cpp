// SPDX-License-Identifier: MIT
#include "ajna/io/file.hpp"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstring>
#include <string>
#include <system_error>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::io {
namespace fs = std::filesystem;
namespace {

/// A file descriptor that closes itself.
class Descriptor {
 public:
  explicit Descriptor(int fd) : fd_(fd) {}
  ~Descriptor() {
    if (fd_ >= 0) {
      ::close(fd_);
    }
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  [[nodiscard]] int get() const noexcept { return fd_; }

 private:
  int fd_;
};

std::string reason(int error) { return std::system_category().message(error); }

}  // namespace

Bytes read_file(const fs::path& path, std::size_t max_bytes) {
  const std::string name = path.string();
  // O_NONBLOCK: opening a pipe must not wait for its writer; it is refused below.
  const Descriptor file(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (file.get() < 0) {
    const int error = errno;
    if (error == ENOENT || error == ENOTDIR) {
      throw_not_found(name, "check the path");
    }
    throw_runtime("file '" + name + "' cannot be opened (" + reason(error) + "): check its permissions");
  }
  struct stat info {};
  if (::fstat(file.get(), &info) != 0) {
    throw_runtime("file '" + name + "' cannot be examined (" + reason(errno) + "): check the disk");
  }
  if (S_ISDIR(info.st_mode)) {
    throw_invalid("'" + name + "' is a folder: give a file");
  }
  if (!S_ISREG(info.st_mode)) {
    throw_invalid("'" + name + "' is a device or a pipe: give a regular file");
  }
  if (info.st_size <= 0) {
    throw_invalid("file '" + name + "' is empty: give a file with content");
  }
  const auto size = static_cast<std::uintmax_t>(info.st_size);
  if (size > max_bytes) {
    throw_invalid("file '" + name + "' has " + std::to_string(size) + " bytes: at most " + std::to_string(max_bytes) +
                  " are read");
  }
  Bytes bytes(static_cast<std::size_t>(size));
  std::size_t done = 0;
  while (done < bytes.size()) {
    const ssize_t got = ::read(file.get(), bytes.data() + done, bytes.size() - done);
    if (got < 0 && errno == EINTR) {
      continue;
    }
    if (got < 0) {
      throw_runtime("file '" + name + "' cannot be read (" + reason(errno) + "): check the disk");
    }
    if (got == 0) {
      throw_runtime("file '" + name + "' shrank while it was read: try again when its writer has finished");
    }
    done += static_cast<std::size_t>(got);
  }
  return bytes;
}

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

}  // namespace ajna::io
