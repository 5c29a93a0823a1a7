// SPDX-License-Identifier: MIT
#include "ajna/tasks/map_histogram.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <tuple>

namespace ajna::tasks {

std::pair<double, double> range_of(const cv::Mat& map, const cv::Mat& counted) {
  constexpr int kLanes = 8;
  std::array<float, kLanes> least;
  std::array<float, kLanes> most;
  least.fill(std::numeric_limits<float>::infinity());
  most.fill(-std::numeric_limits<float>::infinity());
  for (int y = 0; y < map.rows; ++y) {
    const float* row = map.ptr<float>(y);
    const std::uint8_t* counts = counted.empty() ? nullptr : counted.ptr<std::uint8_t>(y);
    for (int begin = 0; begin < map.cols; begin += kLanes) {
      const int lanes = std::min(kLanes, map.cols - begin);
      for (int k = 0; k < lanes; ++k) {
        const auto lane = static_cast<std::size_t>(k);
        const bool skipped = counts != nullptr && counts[begin + k] == 0;
        const float low = skipped ? least[lane] : row[begin + k];
        const float high = skipped ? most[lane] : row[begin + k];
        least[lane] = low < least[lane] ? low : least[lane];
        most[lane] = high > most[lane] ? high : most[lane];
      }
    }
  }
  const double low = *std::min_element(least.begin(), least.end());
  const double high = *std::max_element(most.begin(), most.end());
  return low <= high ? std::pair{low, high} : std::pair{0.0, 0.0};
}

MapHistogram::MapHistogram(const cv::Mat& map, const cv::Mat& counted) {
  std::tie(least_, most_) = range_of(map, counted);
  if (!(most_ > least_) || !std::isfinite(most_ - least_)) {
    most_ = least_;
    return;
  }
  const float scale = static_cast<float>((kBins - 1) / (most_ - least_));
  const auto base = static_cast<float>(least_);
  for (int y = 0; y < map.rows; ++y) {
    const float* row = map.ptr<float>(y);
    const std::uint8_t* counts = counted.empty() ? nullptr : counted.ptr<std::uint8_t>(y);
    for (int x = 0; x < map.cols; ++x) {
      const float place = (row[x] - base) * scale;
      if ((counts == nullptr || counts[x] != 0) && place >= 0.0F && place < static_cast<float>(kBins)) {
        ++bins_[static_cast<std::size_t>(std::min(cvRound(place), kBins - 1))];
        ++total_;
      }
    }
  }
}

double MapHistogram::quantile(double q) const {
  if (!(most_ > least_)) {
    return least_;
  }
  const double wanted = q * total_;
  double below = 0.0;
  std::size_t bin = 0;
  while (bin + 1 < bins_.size() && below + bins_[bin] < wanted) {
    below += bins_[bin++];
  }
  return least_ + static_cast<double>(bin) * (most_ - least_) / (kBins - 1);
}

double map_quantile(const cv::Mat& map, double q) { return MapHistogram(map).quantile(q); }

}  // namespace ajna::tasks
