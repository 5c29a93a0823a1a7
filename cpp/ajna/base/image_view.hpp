// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace ajna {

/// A non-owning view of an RGB image: uint8, height x width x 3, interleaved, rows `row_stride` bytes apart.
struct ImageView {
  const std::uint8_t* data = nullptr;  ///< first byte (red) of the first pixel
  int width = 0;                       ///< pixels
  int height = 0;                      ///< pixels
  int channels = 3;                    ///< interleaved channels in memory; the network takes 3 (RGB)
  std::ptrdiff_t row_stride = 0;       ///< bytes from one row to the next; at least width * channels

  [[nodiscard]] bool empty() const noexcept { return data == nullptr || width <= 0 || height <= 0; }
};

/// An owning RGB image, tightly packed: uint8, height x width x 3.
class Image {
 public:
  Image() = default;
  /// A black image. Throws Error(kInvalidArgument) where a side is not positive.
  Image(int width, int height);

  [[nodiscard]] int width() const noexcept { return width_; }
  [[nodiscard]] int height() const noexcept { return height_; }
  [[nodiscard]] bool empty() const noexcept { return pixels_.empty(); }
  [[nodiscard]] std::uint8_t* data() noexcept { return pixels_.data(); }
  [[nodiscard]] const std::uint8_t* data() const noexcept { return pixels_.data(); }
  [[nodiscard]] std::size_t size_bytes() const noexcept { return pixels_.size(); }
  [[nodiscard]] ImageView view() const noexcept;

 private:
  int width_ = 0;
  int height_ = 0;
  std::vector<std::uint8_t> pixels_;
};

}  // namespace ajna
