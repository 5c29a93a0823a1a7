// SPDX-License-Identifier: MIT
#include "ajna/tasks/gap.hpp"

#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/tasks/frame_mat.hpp"

namespace ajna::tasks {
namespace {

/// Share of the image that lies inside the contour.
double covered(const std::vector<cv::Point2f>& contour, const cv::Size& size) {
  cv::Mat mask = cv::Mat::zeros(size, CV_8U);
  std::vector<std::vector<cv::Point>> polygon(1);
  for (const cv::Point2f& point : contour) {
    polygon[0].emplace_back(cvRound(point.x), cvRound(point.y));
  }
  cv::fillPoly(mask, polygon, 255);
  return cv::countNonZero(mask) / static_cast<double>(size.area());
}

bool in_image(const Eigen::Vector2d& p, const cv::Size& size) {
  return p.x() >= 0.0 && p.y() >= 0.0 && p.x() < size.width && p.y() < size.height;
}

}  // namespace

const char* to_string(GapStatus status) noexcept {
  switch (status) {
    case GapStatus::kExploring:
      return "exploring";
    case GapStatus::kNoGap:
      return "no_gap";
    case GapStatus::kTracking:
      return "tracking";
    case GapStatus::kThrough:
      return "through";
    case GapStatus::kLost:
      return "lost";
    case GapStatus::kOutOfOrder:
      return "out_of_order";
    case GapStatus::kInvalidInput:
      return "invalid_input";
  }
  return "unknown";
}

void validate(const GapOptions& options) {
  validate(options.detection);
  validate(options.tracker);
  if (options.min_pairs < 1 || options.max_pairs < options.min_pairs) {
    throw_invalid("gap options: give 1 <= min_pairs <= max_pairs");
  }
  if (!(options.through > 0.0 && options.through <= 1.0 && options.max_gap_s > 0.0)) {
    throw_invalid("gap options: give through above 0 and up to 1 and a positive max_gap_s");
  }
}

GapPipeline::GapPipeline(const GapOptions& options, double horizontal_fov_rad)
    : options_(options), horizontal_fov_rad_(horizontal_fov_rad), clock_(options.max_gap_s), tracker_(options.tracker) {
  validate(options);
  geometry::Camera::from_horizontal_fov(1, 1, horizontal_fov_rad);  // throws where it is no angle of a camera
}

void GapPipeline::reset() noexcept {
  clock_.reset();
  phase_ = Phase::kEmpty;
  reference_.release();
  sum_.release();
  pairs_ = 0;
}

void GapPipeline::start(const cv::Mat& grey) {
  reference_ = grey;
  sum_ = cv::Mat::zeros(grey.size(), CV_32F);
  pairs_ = 0;
  phase_ = Phase::kStacking;
}

GapResult GapPipeline::step(const ImageView& frame, const cv::Mat& map, double time_s) {
  GapResult result;
  const cv::Mat rgb = frame_mat(frame);
  if (rgb.empty() || rgb.rows < kMinSide || rgb.cols < kMinSide ||
      (phase_ != Phase::kEmpty && rgb.size() != reference_.size()) ||
      (phase_ == Phase::kStacking && (!is_valid_map(map) || map.size() != rgb.size()))) {
    return result;
  }
  const FrameOrder order = clock_.next(time_s);
  if (order == FrameOrder::kOutOfOrder) {
    result.status = GapStatus::kOutOfOrder;
    return result;
  }
  if (order == FrameOrder::kAfterGap && (phase_ == Phase::kTracking)) {
    phase_ = Phase::kLost;
  }
  cv::Mat grey;
  cv::cvtColor(rgb, grey, cv::COLOR_RGB2GRAY);
  switch (phase_) {
    case Phase::kEmpty:
      start(grey);
      result.status = GapStatus::kExploring;
      return result;
    case Phase::kStacking:
      return stack(grey, map);
    case Phase::kTracking:
      return follow(grey);
    case Phase::kThrough:
      result.status = GapStatus::kThrough;
      return result;
    case Phase::kLost:
      result.status = GapStatus::kLost;
      return result;
  }
  return result;
}

GapResult GapPipeline::stack(const cv::Mat& grey, const cv::Mat& map) {
  GapResult result;
  sum_ += map;
  result.pairs = ++pairs_;
  result.stacked = sum_ / pairs_;
  result.status = GapStatus::kExploring;
  if (pairs_ < options_.min_pairs) {
    return result;
  }
  result.detection = detect_gap(result.stacked, options_.detection);
  if (result.detection.found) {
    tracker_.start(reference_, result.detection.contour);
    if (tracker_.track(grey)) {
      phase_ = Phase::kTracking;
      describe(result, grey.size());
      return result;
    }
    // Seen, but not to be followed from the reference frame to this one: a new reference, nearer, may do.
  }
  if (pairs_ >= options_.max_pairs) {
    result.status = GapStatus::kNoGap;
    start(grey);
  }
  return result;
}

GapResult GapPipeline::follow(const cv::Mat& grey) {
  GapResult result;
  if (!tracker_.track(grey)) {
    phase_ = Phase::kLost;
    result.status = GapStatus::kLost;
    return result;
  }
  describe(result, grey.size());
  return result;
}

void GapPipeline::describe(GapResult& result, const cv::Size& size) {
  result.contour = tracker_.contour();
  result.features = tracker_.features();
  result.side = tracker_.side();
  if (tracker_.expansion().has_focus()) {
    result.focus_px = tracker_.expansion().focus_px();
  }
  if (covered(result.contour, size) >= options_.through) {
    phase_ = Phase::kThrough;
    result.status = GapStatus::kThrough;
    return;
  }
  result.safe_px = median_inside(result.contour, size);
  if (!in_image(result.safe_px, size)) {
    phase_ = Phase::kLost;  // the whole contour has left the image
    result.status = GapStatus::kLost;
    return;
  }
  const auto camera = geometry::Camera::from_horizontal_fov(size.width, size.height, horizontal_fov_rad_);
  result.safe_offset = camera.normalize(result.safe_px);
  result.status = GapStatus::kTracking;
}

}  // namespace ajna::tasks
