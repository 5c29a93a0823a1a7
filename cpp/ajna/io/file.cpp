// SPDX-License-Identifier: MIT
#include "ajna/io/file.hpp"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <string>
#include <system_error>

#include "ajna/base/descriptor.hpp"
#include "ajna/base/error.hpp"

namespace ajna::io {
namespace fs = std::filesystem;
namespace {

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

}  // namespace ajna::io
