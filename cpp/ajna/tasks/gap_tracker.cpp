// SPDX-License-Identifier: MIT
#include "ajna/tasks/gap_tracker.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>

#include "ajna/base/error.hpp"

namespace ajna::tasks {
namespace {

std::vector<cv::Mat> pyramid_of(const cv::Mat& grey, const GapTrackerOptions& options) {
  std::vector<cv::Mat> pyramid;
  cv::buildOpticalFlowPyramid(grey, pyramid, {options.window_px, options.window_px}, options.levels);
  return pyramid;
}

std::vector<Eigen::Vector2d> to_eigen(const std::vector<cv::Point2f>& points) {
  std::vector<Eigen::Vector2d> result;
  result.reserve(points.size());
  for (const cv::Point2f& point : points) {
    result.emplace_back(point.x, point.y);
  }
  return result;
}

bool inside(const cv::Point2f& point, const cv::Size& size) {
  return point.x >= 0.0F && point.y >= 0.0F && point.x < static_cast<float>(size.width) &&
         point.y < static_cast<float>(size.height);
}

/// Only what agrees with its side's motion is worth tracking on.
std::vector<cv::Point2f> inliers_of(const std::vector<cv::Point2f>& points, const geometry::Expansion& expansion) {
  std::vector<cv::Point2f> kept;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (expansion.is_inlier[i]) {
      kept.push_back(points[i]);
    }
  }
  return kept;
}

/// Adds corners in `where` until there are max_features, away from those that exist.
void add_corners(const cv::Mat& grey, cv::Mat where, const GapTrackerOptions& options,
                 std::vector<cv::Point2f>& points) {
  const int missing = options.max_features - static_cast<int>(points.size());
  if (missing <= 0) {
    return;
  }
  for (const cv::Point2f& point : points) {
    cv::circle(where, point, cvRound(options.spacing_px), 0, cv::FILLED);
  }
  std::vector<cv::Point2f> found;
  cv::goodFeaturesToTrack(grey, found, missing, options.quality, options.spacing_px, where);
  points.insert(points.end(), found.begin(), found.end());
}

}  // namespace

const char* to_string(TrackedSide side) noexcept {
  return side == TrackedSide::kForeground ? "foreground" : "background";
}

GapTrackerOptions::GapTrackerOptions() { fit.inlier_px = 1.0; }

void validate(const GapTrackerOptions& options) {
  geometry::validate(options.fit);
  if (options.min_features < options.fit.min_inliers || options.refill_below < options.min_features ||
      options.max_features < options.refill_below) {
    throw_invalid("gap tracker: give fit.min_inliers <= min_features <= refill_below <= max_features");
  }
  if (!(options.quality > 0.0 && options.quality < 1.0 && options.spacing_px >= 1.0 && options.ring > 0.0 &&
        options.max_roundtrip_px > 0.0)) {
    throw_invalid(
        "gap tracker: give quality between 0 and 1, spacing_px of at least 1 and positive ring and max_roundtrip_px");
  }
  if (options.window_px < 5 || options.window_px > 101 || options.levels < 0 || options.levels > 8) {
    throw_invalid("gap tracker: give window_px from 5 to 101 and levels from 0 to 8");
  }
}

GapTracker::GapTracker(const GapTrackerOptions& options) : options_(options) { validate(options); }

void GapTracker::start(const cv::Mat& grey, const std::vector<cv::Point2f>& contour) {
  contour_ = contour;
  features_ = {};
  side_ = TrackedSide::kForeground;
  expansion_ = {};
  pyramid_ = pyramid_of(grey, options_);
  refill(grey);
}

void GapTracker::refill(const cv::Mat& grey) {
  const auto few = [&](const std::vector<cv::Point2f>& points) {
    return static_cast<int>(points.size()) < options_.refill_below;
  };
  if (!few(features_.foreground) && !few(features_.background)) {
    return;
  }
  cv::Mat gap = cv::Mat::zeros(grey.size(), CV_8U);
  std::vector<std::vector<cv::Point>> polygon(1);
  for (const cv::Point2f& point : contour_) {
    polygon[0].emplace_back(cvRound(point.x), cvRound(point.y));
  }
  cv::fillPoly(gap, polygon, 255);
  const double diameter = std::sqrt(4.0 * std::max(1.0, cv::contourArea(contour_)) / M_PI);
  const int margin = std::clamp(cvRound(0.06 * diameter), 2, 12);  // the contour is not exact: neither side at the rim
  const int reach = std::clamp(cvRound(options_.ring * diameter), margin + 4, grey.cols / 2);
  cv::Mat away;
  cv::distanceTransform(gap == 0, away, cv::DIST_L2, 3);
  if (few(features_.foreground)) {
    add_corners(grey, (away > margin) & (away < reach), options_, features_.foreground);
  }
  if (few(features_.background)) {
    cv::Mat depth;
    cv::distanceTransform(gap, depth, cv::DIST_L2, 3);
    add_corners(grey, depth > margin, options_, features_.background);
  }
}

GapTracker::Side GapTracker::advance(const std::vector<cv::Point2f>& points, const std::vector<cv::Mat>& next) const {
  Side side;
  if (!points.empty()) {
    const cv::Size window(options_.window_px, options_.window_px);
    std::vector<cv::Point2f> forward;
    std::vector<cv::Point2f> back = points;
    std::vector<std::uint8_t> found;
    std::vector<std::uint8_t> found_back;
    const cv::TermCriteria stop(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 15, 0.03);
    cv::calcOpticalFlowPyrLK(pyramid_, next, points, forward, found, cv::noArray(), window, options_.levels, stop);
    cv::calcOpticalFlowPyrLK(next, pyramid_, forward, back, found_back, cv::noArray(), window, options_.levels, stop,
                             cv::OPTFLOW_USE_INITIAL_FLOW);
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (found[i] != 0 && found_back[i] != 0 && cv::norm(back[i] - points[i]) <= options_.max_roundtrip_px &&
          inside(forward[i], next[0].size())) {
        side.begin.push_back(points[i]);
        side.end.push_back(forward[i]);
      }
    }
  }
  side.expansion = geometry::fit_expansion(to_eigen(side.begin), to_eigen(side.end), options_.fit);
  return side;
}

bool GapTracker::track(const cv::Mat& grey) {
  std::vector<cv::Mat> next = pyramid_of(grey, options_);
  const Side foreground = advance(features_.foreground, next);
  const Side background = advance(features_.background, next);
  const auto usable = [&](const Side& side) {
    return side.expansion.status == geometry::FitStatus::kOk && side.expansion.inliers >= options_.min_features;
  };
  if (!usable(foreground) && !usable(background)) {
    return false;
  }
  const bool by_foreground = usable(foreground);
  side_ = by_foreground ? TrackedSide::kForeground : TrackedSide::kBackground;
  expansion_ = (by_foreground ? foreground : background).expansion;
  for (cv::Point2f& point : contour_) {
    const Eigen::Vector2d moved = expansion_.apply({point.x, point.y});
    point = {static_cast<float>(moved.x()), static_cast<float>(moved.y())};
  }
  features_.foreground = usable(foreground) ? inliers_of(foreground.end, foreground.expansion) : foreground.end;
  features_.background = usable(background) ? inliers_of(background.end, background.expansion) : background.end;
  pyramid_ = std::move(next);
  refill(grey);
  return true;
}

}  // namespace ajna::tasks
