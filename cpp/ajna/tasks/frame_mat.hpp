// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>

#include "ajna/base/image_view.hpp"

namespace ajna::tasks {

/// An OpenCV header over an RGB frame, without copying; empty for views that are no RGB image.
/// The pixels are only read: OpenCV has no header over constant data.
inline cv::Mat frame_mat(const ImageView& frame) {
  if (frame.empty() || frame.channels != 3) {
    return {};
  }
  return {frame.height, frame.width, CV_8UC3, const_cast<std::uint8_t*>(frame.data),
          static_cast<std::size_t>(frame.row_stride)};
}

}  // namespace ajna::tasks
