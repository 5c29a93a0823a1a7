// SPDX-License-Identifier: MIT
#pragma once

#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <string>
#include <utility>
#include <vector>

#include "textured_frames.hpp"

// Synthetic maps of uncertainty and frames for the tests of `tasks`.

namespace ajna::tasks {

using testing::kHeight;
using testing::kWidth;
using testing::textured;
using testing::view_of;

/// A map at `level` with reproducible noise.
inline cv::Mat calm_map(double level = 0.3, double noise = 0.02) {
  cv::Mat map(kHeight, kWidth, CV_32F);
  cv::RNG random(7);
  random.fill(map, cv::RNG::UNIFORM, level - noise, level + noise);
  return map;
}

inline cv::Mat with_disc(cv::Mat map, cv::Point center, int radius, double level) {
  cv::circle(map, center, radius, level, cv::FILLED);
  return map;
}

inline cv::Mat with_ring(cv::Mat map, cv::Point center, int radius, int thickness, double level) {
  cv::circle(map, center, radius, level, thickness);
  return map;
}

/// A trunk from top to bottom: both rims, as a network sees them; the inside is as certain as the rest.
inline cv::Mat trunk(int x, int width, double level) {
  cv::Mat map = calm_map();
  map(cv::Rect(x, 0, 5, kHeight)) = level;
  map(cv::Rect(x + width - 5, 0, 5, kHeight)) = level;
  return map;
}

/// Maps that no pipeline can draw anything from, by name.
inline std::vector<std::pair<std::string, cv::Mat>> unusable_maps() {
  cv::Mat nan = calm_map();
  nan.at<float>(100, 100) = std::numeric_limits<float>::quiet_NaN();
  cv::Mat infinite = calm_map();
  infinite.at<float>(0, 0) = std::numeric_limits<float>::infinity();
  cv::Mat negative = calm_map();
  negative.at<float>(10, 10) = -1.0F;
  return {{"empty", cv::Mat()},
          {"one pixel", cv::Mat(1, 1, CV_32F, cv::Scalar(1.0))},
          {"all NaN", cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(std::nan("")))},
          {"one NaN", nan},
          {"infinite", infinite},
          {"negative", negative},
          {"bytes", cv::Mat(kHeight, kWidth, CV_8U, cv::Scalar(1))}};
}

inline double iou(const cv::Mat& a, const cv::Mat& b) {
  return cv::countNonZero(a & b) / std::max(1.0, static_cast<double>(cv::countNonZero(a | b)));
}

}  // namespace ajna::tasks
