// SPDX-License-Identifier: MIT
#pragma once

#include <string>

#include "ajna/io/file.hpp"

namespace ajna::io {

/// The image formats that are read, recognised by content, never by the file's name.
enum class ImageFormat { kPng, kJpeg, kBmp, kPnm };

/// What the container says about itself.
struct ImageHeader {
  ImageFormat format = ImageFormat::kPng;
  int width = 0;      ///< pixels
  int height = 0;     ///< pixels
  int bit_depth = 8;  ///< bits per sample
  int channels = 3;   ///< samples per pixel in the file (alpha included; 1 for a palette)
};

/// Largest accepted picture: 2^27 pixels (134 megapixels), far above any camera; larger claims are an attack or a bug.
inline constexpr long long kMaxPixels = 1LL << 27;

/// Walk the container from end to end before any decoder sees it: the decoders behind OpenCV hand out half-grey
/// pictures for truncated files. Checked: sizes, chunk lengths and CRCs (PNG), segments up to the end marker (JPEG),
/// pixel data present (BMP, PNM). `name` is used in messages. Throws Error(kInvalidArgument).
ImageHeader check_image_file(const Bytes& bytes, const std::string& name);

/// Throws Error(kInvalidArgument) unless 1 <= width, height and width * height <= kMaxPixels.
void check_image_size(long long width, long long height, const std::string& name);

}  // namespace ajna::io
