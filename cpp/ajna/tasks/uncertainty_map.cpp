// SPDX-License-Identifier: MIT
#include "ajna/tasks/uncertainty_map.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/tasks/map_histogram.hpp"

namespace ajna::tasks {
namespace {

void require(bool valid, const char* what) {
  if (!valid) {
    throw_invalid(what);
  }
}

cv::Mat kernel(int shape, int side) { return cv::getStructuringElement(shape, {side, side}); }

void clear_border(cv::Mat& mask, int border_px) {
  const int b = std::min({border_px, mask.rows / 2, mask.cols / 2});
  if (b > 0) {
    mask.rowRange(0, b).setTo(0);
    mask.rowRange(mask.rows - b, mask.rows).setTo(0);
    mask.colRange(0, b).setTo(0);
    mask.colRange(mask.cols - b, mask.cols).setTo(0);
  }
}

/// The part of `map` that lies in `counted` (all of it where that is empty) and inside the border.
cv::Mat inside_border(const cv::Mat& map, int border_px, const cv::Rect& counted) {
  const int b = std::min({border_px, (map.rows - 1) / 2, (map.cols - 1) / 2});
  const cv::Rect inner(b, b, map.cols - 2 * b, map.rows - 2 * b);
  const cv::Rect part = counted & inner;
  return map(part.empty() ? inner : part);
}

/// Components of `mask` with their statistics over `scalar`.
void measure_regions(MapSteps& steps, const MapOptions& options) {
  steps.labels = cv::Mat::zeros(steps.mask.size(), CV_32S);
  const cv::Rect part = cv::boundingRect(steps.mask);  // most of a map is calm
  if (part.empty()) {
    return;
  }
  cv::Mat labels;
  cv::Mat stats;
  cv::Mat centroids;
  const int count = cv::connectedComponentsWithStats(steps.mask(part), labels, stats, centroids, 8, CV_32S);
  labels.copyTo(steps.labels(part));
  std::vector<double> sum(static_cast<std::size_t>(count));
  std::vector<float> peak(static_cast<std::size_t>(count));
  double inside = 0.0;
  for (int y = 0; y < labels.rows; ++y) {
    const int* label = labels.ptr<int>(y);
    const float* value = steps.scalar.ptr<float>(y + part.y) + part.x;
    for (int x = 0; x < labels.cols; ++x) {
      if (label[x] != 0) {
        const auto k = static_cast<std::size_t>(label[x]);
        sum[k] += value[x];
        peak[k] = std::max(peak[k], value[x]);
        inside += value[x];
      }
    }
  }
  const double pixels = static_cast<double>(steps.mask.total());
  const double calm_px = pixels - part.area() + stats.at<int>(0, cv::CC_STAT_AREA);
  const double outside = std::max(0.0, cv::sum(steps.scalar)[0] - inside) / std::max(1.0, calm_px);
  const int margin = options.border_px + 1;
  const cv::Rect inner(margin, margin, steps.mask.cols - 2 * margin, steps.mask.rows - 2 * margin);
  for (int k = 1; k < count; ++k) {
    Region region;
    region.area_px = stats.at<int>(k, cv::CC_STAT_AREA);
    if (region.area_px < options.min_area * pixels || region.area_px > options.max_area * pixels) {
      continue;
    }
    region.label = k;
    region.box = cv::Rect(stats.at<int>(k, cv::CC_STAT_LEFT), stats.at<int>(k, cv::CC_STAT_TOP),
                          stats.at<int>(k, cv::CC_STAT_WIDTH), stats.at<int>(k, cv::CC_STAT_HEIGHT)) +
                 part.tl();
    region.centroid_px = cv::Point2d(centroids.at<double>(k, 0), centroids.at<double>(k, 1)) + cv::Point2d(part.tl());
    region.mean = sum[static_cast<std::size_t>(k)] / region.area_px;
    region.peak = peak[static_cast<std::size_t>(k)];
    region.outside = outside;
    region.touches_border = (region.box & inner) != region.box;
    steps.regions.push_back(region);
  }
  std::stable_sort(steps.regions.begin(), steps.regions.end(),
                   [](const Region& a, const Region& b) { return a.area_px > b.area_px; });
}

}  // namespace

const char* to_string(ScalarKind kind) noexcept {
  switch (kind) {
    case ScalarKind::kNorm:
      return "norm";
    case ScalarKind::kMax:
      return "max";
    case ScalarKind::kX:
      return "x";
    case ScalarKind::kY:
      return "y";
  }
  return "unknown";
}

const char* to_string(ThresholdRule rule) noexcept {
  switch (rule) {
    case ThresholdRule::kFixed:
      return "fixed";
    case ThresholdRule::kQuantile:
      return "quantile";
    case ThresholdRule::kOtsu:
      return "otsu";
    case ThresholdRule::kMedianMad:
      return "median_mad";
  }
  return "unknown";
}

const char* to_string(MapStatus status) noexcept {
  switch (status) {
    case MapStatus::kOk:
      return "ok";
    case MapStatus::kFlat:
      return "flat";
    case MapStatus::kInvalidInput:
      return "invalid_input";
  }
  return "unknown";
}

double Region::contrast() const noexcept {
  return outside > 0.0 ? mean / outside : std::numeric_limits<double>::infinity();
}

void validate(const MapOptions& options) {
  require(options.smooth_px >= 0.0 && options.smooth_px <= 50.0, "map options: give smooth_px from 0 to 50");
  require(options.background_px >= 0.0 && options.background_px <= 10000.0,
          "map options: give background_px from 0 (none) to 10000");
  require(options.border_px >= 0 && options.border_px <= 1000, "map options: give border_px from 0 to 1000");
  require(options.low_quantile >= 0.0 && options.low_quantile < options.high_quantile && options.high_quantile <= 1.0,
          "map options: give 0 <= low_quantile < high_quantile <= 1");
  require(options.min_range >= 0.0, "map options: give min_range of at least 0");
  require(options.fixed >= 0.0 && options.fixed <= 1.0, "map options: give fixed from 0 to 1, of the normalised map");
  require(options.quantile >= 0.0 && options.quantile <= 1.0, "map options: give quantile from 0 to 1");
  require(options.mad_factor >= 0.0, "map options: give mad_factor of at least 0");
  require(options.open_px >= 0 && options.open_px <= 255 && options.close_px >= 0 && options.close_px <= 255,
          "map options: give open_px and close_px from 0 to 255");
  require(options.min_area >= 0.0 && options.min_area <= options.max_area && options.max_area <= 1.0,
          "map options: give 0 <= min_area <= max_area <= 1, as shares of the image");
}

cv::Mat scalar_map(const cv::Mat& per_axis, ScalarKind kind) {
  if (per_axis.type() != CV_32FC2 || per_axis.empty()) {
    return {};
  }
  cv::Mat map(per_axis.size(), CV_32F);
  for (int y = 0; y < map.rows; ++y) {
    const auto* in = per_axis.ptr<cv::Vec2f>(y);
    auto* out = map.ptr<float>(y);
    for (int x = 0; x < map.cols; ++x) {
      const float u = in[x][0];
      const float v = in[x][1];
      switch (kind) {
        case ScalarKind::kNorm:
          out[x] = std::sqrt(u * u + v * v);
          break;
        case ScalarKind::kMax:
          out[x] = u >= v || std::isnan(u) ? u : v;
          break;
        case ScalarKind::kX:
          out[x] = u;
          break;
        case ScalarKind::kY:
          out[x] = v;
          break;
      }
    }
  }
  return map;
}

cv::Mat scalar_map(const FlowField& field, ScalarKind kind) {
  if (field.width <= 0 || field.height <= 0 || field.uncertainty.size() != field.index(0, field.height)) {
    return {};
  }
  // Only read: OpenCV has no header over constant data.
  return scalar_map(cv::Mat(field.height, field.width, CV_32FC2, const_cast<float*>(field.uncertainty.data())), kind);
}

bool is_valid_map(const cv::Mat& map) {
  if (map.type() != CV_32F || map.dims != 2 || map.rows < kMinSide || map.cols < kMinSide) {
    return false;
  }
  return cv::checkRange(map, true, nullptr, 0.0, static_cast<double>(std::numeric_limits<float>::max()));
}

double threshold_of(const cv::Mat& normalized, const MapOptions& options) {
  switch (options.rule) {
    case ThresholdRule::kFixed:
      return options.fixed;
    case ThresholdRule::kQuantile:
      return map_quantile(normalized, options.quantile);
    case ThresholdRule::kOtsu: {
      cv::Mat grey;
      normalized.convertTo(grey, CV_8U, 255.0);
      return cv::threshold(grey, grey, 0, 255, cv::THRESH_BINARY | cv::THRESH_OTSU) / 255.0;
    }
    case ThresholdRule::kMedianMad: {
      const double median = map_quantile(normalized, 0.5);
      const double mad = map_quantile(cv::abs(normalized - median), 0.5);
      return median + options.mad_factor * mad;
    }
  }
  return 1.0;
}

cv::Mat morphology(const cv::Mat& mask, int open_px, int close_px, bool fill_holes) {
  cv::Mat result = mask.clone();
  if (open_px > 1) {
    cv::morphologyEx(result, result, cv::MORPH_OPEN, kernel(cv::MORPH_ELLIPSE, open_px));
  }
  if (close_px > 1) {
    cv::morphologyEx(result, result, cv::MORPH_CLOSE, kernel(cv::MORPH_RECT, close_px));
  }
  if (fill_holes) {
    std::vector<std::vector<cv::Point>> contours;
    cv::findContours(result, contours, cv::RETR_EXTERNAL, cv::CHAIN_APPROX_NONE);
    cv::drawContours(result, contours, -1, 255, cv::FILLED);
  }
  return result;
}

std::vector<cv::Point> convex_hull(const cv::Mat& mask) {
  std::vector<cv::Point> ends;  // of every row: its other pixels lie between them
  const cv::Rect part = cv::boundingRect(mask);
  for (int y = part.y; y < part.br().y; ++y) {
    const auto* row = mask.ptr<std::uint8_t>(y);
    int first = part.x;
    int last = part.br().x - 1;
    while (first <= last && row[first] == 0) {
      ++first;
    }
    while (last > first && row[last] == 0) {
      --last;
    }
    if (first <= last) {
      ends.emplace_back(first, y);
      ends.emplace_back(last, y);
    }
  }
  std::vector<cv::Point> hull;
  if (!ends.empty()) {
    cv::convexHull(ends, hull);
  }
  return hull;
}

MapSteps find_regions(const cv::Mat& map, const MapOptions& options, const cv::Rect& counted) {
  validate(options);
  MapSteps steps;
  if (!is_valid_map(map)) {
    return steps;
  }
  // Never in place: the map belongs to the caller.
  if (options.smooth_px <= 0.0) {
    steps.scalar = map.clone();
  } else {
    cv::GaussianBlur(map, steps.scalar, {}, options.smooth_px, options.smooth_px, cv::BORDER_REPLICATE);
  }
  cv::Mat relief = steps.scalar;
  if (options.background_px > 0.0) {
    const int side = 2 * static_cast<int>(options.background_px / 2.0) + 1;
    cv::Mat background;
    cv::boxFilter(steps.scalar, background, CV_32F, {side, side}, {-1, -1}, true, cv::BORDER_REFLECT);
    relief = steps.scalar - background;
  }
  const MapHistogram histogram(inside_border(relief, options.border_px, counted));
  steps.low = histogram.quantile(options.low_quantile);
  steps.high = histogram.quantile(options.high_quantile);
  const double range = steps.high - steps.low;
  // All-equal maps differ by rounding after smoothing: their range is no range.
  const double largest = range_of(steps.scalar).second;
  if (range <= options.min_range || range <= 1e-5 * largest) {
    steps.status = MapStatus::kFlat;
    return steps;
  }
  relief.convertTo(steps.normalized, CV_32F, 1.0 / range, -steps.low / range);
  cv::max(steps.normalized, 0.0, steps.normalized);
  cv::min(steps.normalized, 1.0, steps.normalized);
  steps.threshold = threshold_of(inside_border(steps.normalized, options.border_px, counted), options);
  cv::compare(steps.normalized, steps.threshold, steps.raw_mask, cv::CMP_GT);
  clear_border(steps.raw_mask, options.border_px);
  steps.mask = morphology(steps.raw_mask, options.open_px, options.close_px, options.fill_holes);
  measure_regions(steps, options);
  steps.status = MapStatus::kOk;
  return steps;
}

FreeSpace largest_free_space(const cv::Mat& unsafe, const cv::Rect& window, const std::optional<cv::Point2d>& before,
                             double keep) {
  require(unsafe.type() == CV_8U && !unsafe.empty(), "free space: give a mask of 8-bit pixels");
  FreeSpace space;
  space.mask = cv::Mat::zeros(unsafe.size(), CV_8U);
  const cv::Rect part = window & cv::Rect(0, 0, unsafe.cols, unsafe.rows);
  if (part.empty()) {
    return space;
  }
  const cv::Mat free = unsafe(part) == 0;
  cv::Mat labels;
  cv::Mat stats;
  cv::Mat centroids;
  const int count = cv::connectedComponentsWithStats(free, labels, stats, centroids, 4, CV_32S);
  int kept = 0;
  if (before) {
    const cv::Point inside(cvRound(before->x) - part.x, cvRound(before->y) - part.y);
    kept = cv::Rect(0, 0, part.width, part.height).contains(inside) ? labels.at<int>(inside) : 0;
  }
  int best = 0;
  double best_area = 0.0;
  for (int k = 1; k < count; ++k) {
    const double area = stats.at<int>(k, cv::CC_STAT_AREA) * (k == kept ? keep : 1.0);
    if (area > best_area) {
      best = k;
      best_area = area;
    }
  }
  if (best == 0) {
    return space;
  }
  const cv::Mat chosen = labels == best;
  chosen.copyTo(space.mask(part));
  cv::Mat padded;
  cv::copyMakeBorder(chosen, padded, 1, 1, 1, 1, cv::BORDER_CONSTANT, 0);
  cv::Mat distance;
  cv::distanceTransform(padded, distance, cv::DIST_L2, cv::DIST_MASK_5);
  cv::Point center(cvRound(centroids.at<double>(best, 0)), cvRound(centroids.at<double>(best, 1)));
  space.center_px = {centroids.at<double>(best, 0), centroids.at<double>(best, 1)};
  if (chosen.at<std::uint8_t>(center) == 0) {
    cv::Point deepest;
    cv::minMaxLoc(distance, nullptr, nullptr, nullptr, &deepest);
    center = deepest - cv::Point(1, 1);
    space.center_px = center;
  }
  space.clearance_px = static_cast<double>(distance.at<float>(center + cv::Point(1, 1)));
  space.center_px += cv::Point2d(part.tl());
  space.area_px = stats.at<int>(best, cv::CC_STAT_AREA);
  space.found = true;
  return space;
}

}  // namespace ajna::tasks
