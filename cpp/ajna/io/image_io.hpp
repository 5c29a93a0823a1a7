// SPDX-License-Identifier: MIT
#pragma once

#include <filesystem>

#include "ajna/base/image_view.hpp"

namespace ajna::io {

/// Read a PNG, JPEG, BMP, PPM or PGM file as RGB. The format is recognised by content, not by name. Grey and palette
/// images become RGB, alpha is dropped, samples deeper than 8 bits are scaled to 8 (rounding to nearest), EXIF
/// orientation is applied. Truncated files are refused, never completed with grey.
/// Throws Error: kFileNotFound for a missing file, kInvalidArgument for everything that is not a whole image.
Image read_image(const std::filesystem::path& path);

/// Write RGB as .png, .jpg/.jpeg (quality 95), .bmp or .ppm, by the extension; atomically.
/// Throws Error: kInvalidArgument for an empty image, a channel count other than 3 or an unknown extension; kRuntime
/// where the system refuses to write.
void write_image(const std::filesystem::path& path, const ImageView& image);

/// Another size; each new pixel is the mean of those that fall into it, as the training data were scaled. A view of the
/// wanted size is copied. Throws Error(kInvalidArgument) for an empty image, channels other than 3 and sides below 1.
Image resize_image(const ImageView& image, int width, int height);

}  // namespace ajna::io
