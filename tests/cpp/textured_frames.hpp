// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "ajna/base/image_view.hpp"

// Frames that tests and benchmarks are fed with.

namespace ajna::testing {

constexpr int kWidth = 320;
constexpr int kHeight = 240;

/// A frame that owns its pixels: RGB noise texture, as a wall has it.
inline cv::Mat textured(int seed) {
  cv::Mat image(kHeight, kWidth, CV_8UC3);
  cv::RNG random(static_cast<std::uint64_t>(seed));
  random.fill(image, cv::RNG::UNIFORM, 0, 256);
  cv::GaussianBlur(image, image, {0, 0}, 2.0);
  cv::normalize(image, image, 0, 255, cv::NORM_MINMAX);
  return image;
}

inline ImageView view_of(const cv::Mat& image) {
  return {image.data, image.cols, image.rows, 3, static_cast<std::ptrdiff_t>(image.step[0])};
}

}  // namespace ajna::testing
