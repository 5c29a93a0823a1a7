// SPDX-License-Identifier: MIT
#include "ajna/tasks/gap_detection.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/tasks/map_histogram.hpp"

namespace ajna::tasks {
namespace {

/// The coordinate below which half of the pixels lie, from the number of pixels per row or column.
double median_of(const std::vector<int>& histogram, int total) {
  int below = 0;
  for (std::size_t i = 0; i < histogram.size(); ++i) {
    if (2 * (below + histogram[i]) >= total) {
      return static_cast<double>(i);
    }
    below += histogram[i];
  }
  return 0.0;
}

Eigen::Vector2d median_pixel(const cv::Mat& mask) {
  std::vector<int> columns(static_cast<std::size_t>(mask.cols));
  std::vector<int> rows(static_cast<std::size_t>(mask.rows));
  int total = 0;
  for (int y = 0; y < mask.rows; ++y) {
    const auto* row = mask.ptr<std::uint8_t>(y);
    for (int x = 0; x < mask.cols; ++x) {
      if (row[x] != 0) {
        ++columns[static_cast<std::size_t>(x)];
        ++rows[static_cast<std::size_t>(y)];
        ++total;
      }
    }
  }
  return {median_of(columns, total), median_of(rows, total)};
}

/// Mean of the map inside `mask` over its mean in a ring about it.
double ring_contrast(const cv::Mat& map, const cv::Mat& mask, const Region& region, double ring) {
  const int width = std::max(3, cvRound(ring * std::sqrt(4.0 * region.area_px / M_PI)));
  const cv::Rect image(0, 0, mask.cols, mask.rows);
  const cv::Rect part = cv::Rect(region.box.x - width, region.box.y - width, region.box.width + 2 * width,
                                 region.box.height + 2 * width) &
                        image;
  cv::Mat grown;
  cv::dilate(mask(part), grown, cv::getStructuringElement(cv::MORPH_RECT, {2 * width + 1, 2 * width + 1}));
  cv::Mat around = grown & ~mask(part);
  if (cv::countNonZero(around) == 0) {
    return 0.0;
  }
  const double outside = cv::mean(map(part), around)[0];
  const double inside = cv::mean(map(part), mask(part))[0];
  return outside > 0.0 ? inside / outside : std::numeric_limits<double>::infinity();
}

double inscribed_diameter(const cv::Mat& mask) {
  cv::Mat padded;
  cv::copyMakeBorder(mask, padded, 1, 1, 1, 1, cv::BORDER_CONSTANT, 0);
  cv::Mat distance;
  cv::distanceTransform(padded, distance, cv::DIST_L2, 3);
  double deepest = 0.0;
  cv::minMaxLoc(distance, nullptr, &deepest);
  return 2.0 * deepest;
}

}  // namespace

GapDetectionOptions::GapDetectionOptions() {
  map.smooth_px = 2.0;
  map.border_px = 20;
  map.rule = ThresholdRule::kFixed;
  map.fixed = 0.35;
  map.open_px = 0;
  map.close_px = 41;
  map.min_area = 0.005;
  map.max_area = 0.5;
}

void validate(const GapDetectionOptions& options) {
  validate(options.map);
  if (!(options.min_contrast >= 1.0 && options.ring > 0.0 && options.min_solidity >= 0.0 &&
        options.min_solidity <= 1.0 && options.min_thickness >= 0.0 && options.min_thickness <= 1.0)) {
    throw_invalid(
        "gap detection: give min_contrast of at least 1, a positive ring, and min_solidity and min_thickness from 0 to "
        "1");
  }
  if (options.retries < 0 || options.retries > 8) {
    throw_invalid("gap detection: give retries from 0 to 8");
  }
}

namespace {

/// The best gap among regions of `steps`; contrast is that of the region against its ring, or of the ring against it.
GapDetection best_region(MapSteps steps, const cv::Mat& scalar, bool certain, const GapDetectionOptions& options) {
  GapDetection result;
  double best = 0.0;
  for (const Region& region : steps.regions) {
    if (region.touches_border) {
      continue;
    }
    const cv::Mat mask = steps.labels == region.label;
    std::vector<std::vector<cv::Point>> contours;
    cv::findContours(mask, contours, cv::RETR_EXTERNAL, cv::CHAIN_APPROX_NONE);
    std::vector<cv::Point> hull;
    cv::convexHull(contours.front(), hull);
    const double solidity = region.area_px / std::max(1.0, cv::contourArea(hull));
    const double thickness = inscribed_diameter(mask) / std::sqrt(4.0 * region.area_px / M_PI);
    const double ratio = ring_contrast(scalar, mask, region, options.ring);
    const double contrast = certain ? 1.0 / std::max(ratio, 1e-6) : ratio;
    if (solidity < options.min_solidity || thickness < options.min_thickness || contrast < options.min_contrast) {
      continue;
    }
    const double score = (std::min(contrast, 1e6) - 1.0) * std::sqrt(region.area_px);
    if (score > best) {
      best = score;
      result.found = true;
      result.certain = certain;
      result.mask = mask;
      result.contrast = contrast;
      result.score = score;
      result.contour.assign(contours.front().begin(), contours.front().end());
    }
  }
  result.steps = std::move(steps);
  return result;
}

GapDetection detect_once(const cv::Mat& map, const GapDetectionOptions& options) {
  MapSteps steps = find_regions(map, options.map);
  if (steps.status != MapStatus::kOk) {
    GapDetection nothing;
    nothing.steps = std::move(steps);
    return nothing;
  }
  const cv::Mat scalar = steps.scalar;
  GapDetection result = best_region(std::move(steps), scalar, false, options);
  if (options.certain) {
    // The same steps on the map upside down; its top is a quantile, as peaks elsewhere must not set the scale.
    cv::Mat inverse = map_quantile(scalar, 0.95) - scalar;
    cv::max(inverse, 0.0, inverse);
    MapOptions smoothed = options.map;
    smoothed.smooth_px = 0.0;
    GapDetection other = best_region(find_regions(inverse, smoothed), scalar, true, options);
    if (other.found && (!result.found || other.score > result.score)) {
      result = std::move(other);
    }
  }
  if (result.found) {
    result.safe_px = median_pixel(result.mask);
  }
  return result;
}

}  // namespace

GapDetection detect_gap(const cv::Mat& map, const GapDetectionOptions& options) {
  validate(options);
  GapDetection first = detect_once(map, options);
  GapDetectionOptions finer = options;
  for (int i = 0; i < options.retries && !first.found && first.steps.status == MapStatus::kOk; ++i) {
    finer.map.close_px = finer.map.close_px / 2 | 1;  // odd, as a kernel must be
    GapDetection again = detect_once(map, finer);
    if (again.found) {
      return again;
    }
  }
  return first;
}

Eigen::Vector2d median_inside(const std::vector<cv::Point2f>& contour, const cv::Size& size) {
  cv::Mat mask = cv::Mat::zeros(size, CV_8U);
  std::vector<std::vector<cv::Point>> polygon(1);
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (const cv::Point2f& point : contour) {
    polygon[0].emplace_back(cvRound(point.x), cvRound(point.y));
    mean += Eigen::Vector2d(point.x, point.y) / static_cast<double>(contour.size());
  }
  if (contour.empty()) {
    return mean;
  }
  cv::fillPoly(mask, polygon, 255);
  return cv::countNonZero(mask) > 0 ? median_pixel(mask) : mean;
}

}  // namespace ajna::tasks
