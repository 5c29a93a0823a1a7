// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <vector>

namespace ajna::io {

using Bytes = std::vector<std::uint8_t>;

/// The whole of a regular file. Throws Error: kFileNotFound where nothing is there, kInvalidArgument for a folder, a
/// device or pipe, an empty file and a file above `max_bytes`, kRuntime where the system refuses to read it.
Bytes read_file(const std::filesystem::path& path, std::size_t max_bytes);

/// A file that appears under its final name only when complete: write to `temporary()`, then `commit()`.
/// The temporary lies in the same folder (so that the final rename is atomic), keeps the extension (encoders look at
/// it) and is removed by the destructor where commit was not reached.
class AtomicFile {
 public:
  /// Reserves the temporary name. Throws kFileNotFound where the folder is missing, kInvalidArgument where `path` is a
  /// folder, and kRuntime where nothing can be created there.
  explicit AtomicFile(std::filesystem::path path);
  ~AtomicFile();
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

  [[nodiscard]] const std::filesystem::path& path() const noexcept { return path_; }
  [[nodiscard]] const std::filesystem::path& temporary() const noexcept { return temporary_; }

  /// Replace the temporary's content. Throws kRuntime (disk full and the like).
  void write(const void* data, std::size_t size);
  /// Flush to the disk and rename to the final name. Throws kRuntime; the temporary is then removed.
  void commit();

 private:
  std::filesystem::path path_;
  std::filesystem::path temporary_;
  bool committed_ = false;
};

/// `AtomicFile` in one step: the file at `path` is either what it was before or exactly these bytes.
void write_file_atomically(const std::filesystem::path& path, const void* data, std::size_t size);

}  // namespace ajna::io
