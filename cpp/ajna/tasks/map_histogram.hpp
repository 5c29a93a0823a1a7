// SPDX-License-Identifier: MIT
#pragma once

#include <array>
#include <opencv2/core.hpp>
#include <utility>

namespace ajna::tasks {

/// Smallest and largest value of a CV_32F map, of those where `counted` (CV_8U) is not 0, if it is given; (0, 0) where
/// none counts. Several times as fast as cv::minMaxLoc, which wants the place.
std::pair<double, double> range_of(const cv::Mat& map, const cv::Mat& counted = {});

/// The values of a CV_32F map (not empty, finite), those alone where `counted` (CV_8U) is not 0, if it is given.
class MapHistogram {
 public:
  explicit MapHistogram(const cv::Mat& map, const cv::Mat& counted = {});
  /// The value below which a share `q` of them lies, to 1/4096 of their range.
  [[nodiscard]] double quantile(double q) const;

 private:
  static constexpr int kBins = 4096;
  std::array<int, kBins> bins_{};
  double least_ = 0.0;
  double most_ = 0.0;
  int total_ = 0;
};
/// One quantile of it.
double map_quantile(const cv::Mat& map, double q);

}  // namespace ajna::tasks
