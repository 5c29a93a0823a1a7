// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>

namespace ajna::tasks {

/// A CV_32F grid between its nodes; 0 <= row < rows - 1, 0 <= column < columns - 1, which are not checked.
inline double bilinear(const cv::Mat& grid, double row, double column) {
  const int top = cvFloor(row);
  const int left = cvFloor(column);
  const double down = row - top;
  const double right = column - left;
  const auto at = [&](int i, int j) { return static_cast<double>(grid.at<float>(top + i, left + j)); };
  return (1.0 - down) * ((1.0 - right) * at(0, 0) + right * at(0, 1)) +
         down * ((1.0 - right) * at(1, 0) + right * at(1, 1));
}

}  // namespace ajna::tasks
