// SPDX-License-Identifier: MIT
#include "ajna/base/image_view.hpp"

#include <string>

#include "ajna/base/error.hpp"

namespace ajna {

Image::Image(int width, int height) : width_(width), height_(height) {
  if (width <= 0 || height <= 0) {
    throw_invalid("image size " + std::to_string(width) + "x" + std::to_string(height) +
                  ": both sides must be positive");
  }
  pixels_.assign(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3, 0);
}

ImageView Image::view() const noexcept {
  return ImageView{pixels_.data(), width_, height_, 3, static_cast<std::ptrdiff_t>(width_) * 3};
}

}  // namespace ajna
