// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>

#include "ajna/base/image_view.hpp"

namespace ajna::io {

/// Writes a video that appears under its name only when complete: write frames, then close().
/// Without close() the destructor removes the temporary file. Movable.
class VideoWriter {
 public:
  /// `.mp4` (H.264 where OpenCV's FFmpeg can encode it, else MPEG-4) or `.avi` (Motion JPEG). Odd sides grow by one
  /// repeated row or column, because the codecs halve the colour planes.
  /// Throws Error: kInvalidArgument for another extension, a size that is not positive or fps not in (0, 1000];
  /// kFileNotFound or kRuntime where the folder is missing, unwritable, or no encoder is there.
  VideoWriter(const std::filesystem::path& path, int width, int height, double fps);
  ~VideoWriter();
  VideoWriter(VideoWriter&&) noexcept;
  VideoWriter& operator=(VideoWriter&&) noexcept;

  /// Append an RGB frame of the size given on opening. Throws Error(kInvalidArgument) for another size.
  void write(const ImageView& frame);
  /// Finish the file, read it back (the encoder reports no full disk) and put it in place. Throws Error:
  /// kInvalidArgument where no frame was written, kRuntime where the file does not hold the frames.
  void close();
  /// Give up: remove what was written; nothing can be appended afterwards. No effect after close().
  void discard() noexcept;
  [[nodiscard]] std::int64_t frames_written() const noexcept;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace ajna::io
