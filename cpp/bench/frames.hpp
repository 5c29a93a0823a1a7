// SPDX-License-Identifier: MIT
#pragma once

#include <benchmark/benchmark.h>

#include <opencv2/core.hpp>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgproc.hpp>

#include "textured_frames.hpp"

/// What the benchmarks of pipelines and of whole skills are fed with.
namespace ajna::bench {

using testing::kHeight;
using testing::kWidth;
using testing::textured;
using testing::view_of;

/// Noise about 0.3 with rims of things in it, as smooth as a network's map.
inline cv::Mat map_with(cv::Point center, int radius) {
  cv::Mat map(kHeight, kWidth, CV_32F);
  cv::RNG random(7);
  random.fill(map, cv::RNG::UNIFORM, 0.25, 0.35);
  cv::circle(map, center, radius, 1.4, cv::FILLED);
  cv::rectangle(map, {30, 20}, {60, 239}, 0.8, 6);
  cv::GaussianBlur(map, map, {0, 0}, 2.0);
  return map;
}

/// `image`, moved by some pixels.
inline cv::Mat moved(const cv::Mat& image, double right_px, double down_px) {
  const cv::Mat warp = (cv::Mat_<double>(2, 3) << 1, 0, right_px, 0, 1, down_px);
  cv::Mat result;
  cv::warpAffine(image, result, warp, image.size(), cv::INTER_LINEAR, cv::BORDER_REFLECT);
  return result;
}

/// What other figures can be compared with on another machine: one pass over a map.
inline void reference_blur_320x240(benchmark::State& state) {
  cv::setNumThreads(1);
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(0.3F));
  cv::Mat smooth;
  for (auto _ : state) {
    cv::GaussianBlur(map, smooth, {}, 1.5, 1.5, cv::BORDER_REPLICATE);
    benchmark::DoNotOptimize(smooth.data);
  }
}

}  // namespace ajna::bench
