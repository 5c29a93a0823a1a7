// SPDX-License-Identifier: MIT
#include "ajna/tasks/segment.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/tasks/frame_mat.hpp"

namespace ajna::tasks {
namespace {

constexpr int kInside = 1;
constexpr int kOutside = 2;

/// The largest region that stands out, and those about it.
cv::Mat attention_of(const MapSteps& steps, const SegmentOptions& options) {
  cv::Mat mask = cv::Mat::zeros(steps.mask.size(), CV_8U);
  const double reach = options.join * std::hypot(steps.mask.cols, steps.mask.rows);
  cv::Rect near;
  for (const Region& region : steps.regions) {
    if (region.contrast() < options.min_contrast) {
      continue;
    }
    if (!near.empty() && (near & region.box).empty()) {
      continue;
    }
    mask |= steps.labels == region.label;
    const int r = cvRound(reach);
    const cv::Rect grown(region.box.x - r, region.box.y - r, region.box.width + 2 * r, region.box.height + 2 * r);
    near = near.empty() ? grown : near | grown;
  }
  return mask;
}

cv::Mat seeds_of(const cv::Mat& attention, const SegmentOptions& options) {
  cv::Mat inside = cv::Mat::zeros(attention.size(), CV_8U);
  cv::fillConvexPoly(inside, convex_hull(attention), 255);
  cv::Mat padded;
  cv::copyMakeBorder(inside, padded, 1, 1, 1, 1, cv::BORDER_CONSTANT, 0);
  cv::Mat depth;
  cv::distanceTransform(padded, depth, cv::DIST_L2, 3);
  depth = depth(cv::Rect(1, 1, attention.cols, attention.rows));
  double deepest = 0.0;
  cv::minMaxLoc(depth, nullptr, &deepest);
  cv::Mat away;
  cv::distanceTransform(inside == 0, away, cv::DIST_L2, 3);
  cv::Mat seeds(attention.size(), CV_8U, cv::Scalar(128));
  seeds.setTo(255, depth > options.inner * deepest);
  const double diameter = std::sqrt(4.0 * cv::countNonZero(inside) / M_PI);
  seeds.setTo(0, away > std::max(2.0, options.outer * diameter));
  return seeds;
}

cv::Mat by_watershed(const cv::Mat& rgb, const cv::Mat& seeds) {
  cv::Mat smooth;
  cv::GaussianBlur(rgb, smooth, {3, 3}, 0.0);
  cv::Mat markers = cv::Mat::zeros(seeds.size(), CV_32S);
  markers.setTo(kInside, seeds == 255);
  markers.setTo(kOutside, seeds == 0);
  cv::watershed(smooth, markers);
  // Watershed gives its ridges and the image's frame to nobody (-1).
  cv::Mat mask = markers == kInside;
  cv::morphologyEx(mask, mask, cv::MORPH_CLOSE, cv::getStructuringElement(cv::MORPH_RECT, {3, 3}));
  return mask;
}

cv::Mat by_grabcut(const cv::Mat& rgb, const cv::Mat& seeds, const SegmentOptions& options) {
  cv::Mat labels(rgb.size(), CV_8U, cv::Scalar(cv::GC_PR_FGD));
  labels.setTo(cv::GC_FGD, seeds == 255);
  labels.setTo(cv::GC_BGD, seeds == 0);
  // Colour models need samples of both sides.
  constexpr int kFewest = 16;
  if (cv::countNonZero(seeds == 255) < kFewest || cv::countNonZero(seeds == 0) < kFewest) {
    return seeds == 255;
  }
  cv::theRNG().state = 1;  // its k-means is seeded from there: equal input, equal answer
  cv::Mat background;
  cv::Mat foreground;
  cv::grabCut(rgb, labels, {}, background, foreground, options.grabcut_iterations, cv::GC_INIT_WITH_MASK);
  return (labels == cv::GC_FGD) | (labels == cv::GC_PR_FGD);
}

/// Seeds and the outline that grows from them, on a copy no wider than side_px.
void grow(const cv::Mat& rgb, const SegmentOptions& options, SegmentResult& result) {
  const double scale = std::min(1.0, static_cast<double>(options.side_px) / rgb.cols);
  cv::Mat image = rgb;
  cv::Mat attention = result.attention;
  if (scale < 1.0) {
    cv::resize(rgb, image, {}, scale, scale, cv::INTER_AREA);
    cv::resize(result.attention, attention, image.size(), 0, 0, cv::INTER_NEAREST);
  }
  result.seeds = seeds_of(attention, options);
  result.segmentation = options.method == SegmentMethod::kWatershed ? by_watershed(image, result.seeds)
                                                                    : by_grabcut(image, result.seeds, options);
  if (scale < 1.0) {
    cv::resize(result.seeds, result.seeds, rgb.size(), 0, 0, cv::INTER_NEAREST);
    cv::resize(result.segmentation, result.segmentation, rgb.size(), 0, 0, cv::INTER_LINEAR);
    result.segmentation = result.segmentation > 127;
  }
}

}  // namespace

const char* to_string(SegmentStatus status) noexcept {
  switch (status) {
    case SegmentStatus::kOk:
      return "ok";
    case SegmentStatus::kNoObject:
      return "no_object";
    case SegmentStatus::kInvalidInput:
      return "invalid_input";
  }
  return "unknown";
}

const char* to_string(SegmentMethod method) noexcept {
  return method == SegmentMethod::kWatershed ? "watershed" : "grabcut";
}

SegmentOptions::SegmentOptions() {
  map.smooth_px = 2.0;
  map.close_px = 25;
  map.max_area = 0.8;
}

void validate(const SegmentOptions& options) {
  validate(options.map);
  if (!(options.min_contrast >= 1.0 && options.join >= 0.0)) {
    throw_invalid("segment options: give min_contrast of at least 1 and join of at least 0");
  }
  if (!(options.inner >= 0.0 && options.inner < 1.0 && options.outer >= 0.0)) {
    throw_invalid("segment options: give inner from 0 to below 1 and outer of at least 0");
  }
  if (options.grabcut_iterations < 1 || options.side_px < 16) {
    throw_invalid("segment options: give grabcut_iterations of at least 1 and side_px of at least 16");
  }
}

SegmentResult segment_pile(const ImageView& frame, const cv::Mat& map, const SegmentOptions& options) {
  validate(options);
  SegmentResult result;
  const cv::Mat rgb = frame_mat(frame);
  if (rgb.empty() || rgb.size() != map.size()) {
    return result;
  }
  result.steps = find_regions(map, options.map);
  if (result.steps.status == MapStatus::kInvalidInput) {
    return result;
  }
  result.status = SegmentStatus::kNoObject;
  if (result.steps.status == MapStatus::kFlat) {
    return result;
  }
  const cv::Mat attention = attention_of(result.steps, options);
  if (cv::countNonZero(attention) == 0) {
    return result;
  }
  result.attention = attention;
  result.box = cv::boundingRect(attention);
  grow(rgb, options, result);
  result.status = SegmentStatus::kOk;
  return result;
}

}  // namespace ajna::tasks
