// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <filesystem>
#include <functional>
#include <string>

namespace ajna {

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

/// The same for writers that want a file name: `write` gets the temporary name and must fill that file. Where `write`
/// throws, the temporary file is removed and the exception passes through.
void write_atomically(const std::filesystem::path& path,
                      const std::function<void(const std::string& temporary)>& write);

}  // namespace ajna
