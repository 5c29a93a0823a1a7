// SPDX-License-Identifier: MIT
#include "ajna/tasks/dodge.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/geometry/motion_field.hpp"

namespace ajna::tasks {
namespace {

Eigen::Vector2d to_eigen(const cv::Point2d& p) { return {p.x, p.y}; }

/// Slope and value at the last time of a least-squares line through (t, y).
struct LineFit {
  double slope = 0.0;
  double last = 0.0;
};

template <typename Value>
LineFit fit_line(const std::vector<TrackPoint>& track, Value value) {
  double t_mean = 0.0;
  double y_mean = 0.0;
  for (const TrackPoint& point : track) {
    t_mean += point.time_s / static_cast<double>(track.size());
    y_mean += value(point) / static_cast<double>(track.size());
  }
  double tt = 0.0;
  double ty = 0.0;
  for (const TrackPoint& point : track) {
    tt += (point.time_s - t_mean) * (point.time_s - t_mean);
    ty += (point.time_s - t_mean) * (value(point) - y_mean);
  }
  const double slope = tt > 0.0 ? ty / tt : 0.0;
  return {slope, y_mean + slope * (track.back().time_s - t_mean)};
}

cv::Mat obstacle_mask(const MapSteps& steps, const Region& region, bool convex) {
  cv::Mat mask = steps.labels == region.label;
  if (convex) {
    cv::fillConvexPoly(mask, convex_hull(mask), 255);
  }
  return mask;
}

TrackPoint measure(const cv::Mat& mask, double time_s) {
  const cv::Moments moments = cv::moments(mask, true);
  return {time_s, {moments.m10 / moments.m00, moments.m01 / moments.m00}, std::sqrt(4.0 * moments.m00 / M_PI)};
}

}  // namespace

struct DodgePipeline::Motion {
  explicit Motion(const std::vector<TrackPoint>& track)
      : x(fit_line(track, [](const TrackPoint& p) { return p.center_px.x; })),
        y(fit_line(track, [](const TrackPoint& p) { return p.center_px.y; })),
        diameter(fit_line(track, [](const TrackPoint& p) { return p.diameter_px; })) {}
  LineFit x, y, diameter;
};

const char* to_string(DodgeStatus status) noexcept {
  switch (status) {
    case DodgeStatus::kNoObstacle:
      return "no_obstacle";
    case DodgeStatus::kDetected:
      return "detected";
    case DodgeStatus::kIncoming:
      return "incoming";
    case DodgeStatus::kOutOfOrder:
      return "out_of_order";
    case DodgeStatus::kInvalidInput:
      return "invalid_input";
  }
  return "unknown";
}

DodgeOptions::DodgeOptions() {
  map.smooth_px = 1.0;
  map.rule = ThresholdRule::kFixed;  // a share of the peak: Otsu's takes in the halo about a small thing
  map.fixed = 0.6;
  map.high_quantile = 0.9995;  // by less, a small thing would be clipped away with the peaks
  map.open_px = 0;             // the rims of a small thing are thin: what remains of noise is refused by its area
  map.close_px = 9;
  map.min_area = 0.0003;
  map.max_area = 0.25;
}

void validate(const DodgeOptions& options) {
  validate(options.map);
  validate(options.background);
  if (!(options.min_contrast >= 1.0 && options.min_uncertainty >= 0.0)) {
    throw_invalid("dodge options: give min_contrast of at least 1 and min_uncertainty of at least 0");
  }
  if (options.confirm_frames < 2 || options.confirm_frames > 100) {
    throw_invalid("dodge options: give confirm_frames from 2 to 100, as a direction needs two places");
  }
  if (!(options.confirm_s >= 0.0 && std::isfinite(options.confirm_s) && options.min_move >= 0.0)) {
    throw_invalid("dodge options: give confirm_s of at least 0 seconds, min_move of at least 0 image heights");
  }
  if (!(options.gate > 0.0 && options.max_gap_s > 0.0 && options.max_miss_s > 0.0 && options.horizon_s > 0.0 &&
        options.min_growth_per_s > 0.0 && options.direct_hit >= 0.0)) {
    throw_invalid("dodge options: gate, max_gap_s, max_miss_s, horizon_s and min_growth_per_s must be positive");
  }
  if (!(options.vertical >= 0.0 && options.vertical <= 1.0)) {
    throw_invalid("dodge options: give vertical from 0 (sideways only) to 1");
  }
  if (!(options.horizontal_fov_rad > 0.0 && options.horizontal_fov_rad < M_PI)) {
    throw_invalid("dodge options: give horizontal_fov_rad between 0 and pi");
  }
}

DodgePipeline::DodgePipeline(const DodgeOptions& options)
    : options_(options), clock_(options.max_gap_s), background_(options.background) {
  validate(options);
}

void DodgePipeline::reset() noexcept {
  clock_.reset();
  background_.reset();
  track_.clear();
}

MapSteps DodgePipeline::find(const cv::Mat& map, double time_s, double turned_rad) {
  least_ = options_.min_uncertainty;
  if (options_.background.use && is_valid_map(map)) {
    if (const auto rise = background_.step(map, time_s, turned_rad)) {
      MapOptions risen = options_.map;
      risen.smooth_px = risen.background_px = 0.0;  // both are done
      risen.min_range = rise->threshold;
      least_ = risen.fixed * rise->threshold;
      return find_regions(rise->map, risen);
    }
  }
  return find_regions(map, options_.map);
}

std::optional<Region> DodgePipeline::choose(const MapSteps& steps, double time_s) const {
  const double diagonal = std::hypot(steps.mask.cols, steps.mask.rows);
  cv::Point2d expected;
  if (!track_.empty()) {
    expected = track_.back().center_px;
    if (track_.size() > 1) {
      const TrackPoint& before = track_[track_.size() - 2];
      const double ahead = (time_s - track_.back().time_s) / (track_.back().time_s - before.time_s);
      expected += ahead * (track_.back().center_px - before.center_px);
    }
  }
  std::optional<Region> best;
  double best_score = 0.0;
  for (const Region& region : steps.regions) {
    if (region.contrast() < options_.min_contrast || region.mean < least_) {
      continue;
    }
    // How far it stands out, weighted by its diameter (by area, large weak patches would win over small things), and
    // less where the track does not expect it.
    double score = (region.mean - region.outside) * std::sqrt(region.area_px);
    if (!track_.empty()) {
      const double off = cv::norm(region.centroid_px - expected) / (options_.gate * diagonal);
      score *= std::exp(-off * off);
    }
    if (score > best_score) {
      best_score = score;
      best = region;
    }
  }
  return best;
}

DodgeResult DodgePipeline::step(const cv::Mat& map, double time_s,
                                const std::optional<Eigen::Vector3d>& angular_velocity_rad_s) {
  DodgeResult result;
  const FrameOrder order = clock_.next(time_s);
  if (order == FrameOrder::kOutOfOrder) {
    result.status = DodgeStatus::kOutOfOrder;
    result.track = track_;
    return result;
  }
  if (order == FrameOrder::kAfterGap) {
    background_.reset();
    track_.clear();
  }
  const bool turned = angular_velocity_rad_s && angular_velocity_rad_s->allFinite() && order == FrameOrder::kNext;
  result.steps = find(map, time_s, turned ? angular_velocity_rad_s->norm() * clock_.interval_s() : 0.0);
  if (result.steps.status == MapStatus::kInvalidInput) {
    track_.clear();
    result.status = DodgeStatus::kInvalidInput;
    return result;
  }
  if (angular_velocity_rad_s && angular_velocity_rad_s->allFinite() && !track_.empty()) {
    // Old places as the camera would see them now.
    const auto camera = geometry::Camera::from_horizontal_fov(map.cols, map.rows, options_.horizontal_fov_rad);
    const double dt_s = time_s - track_.back().time_s;
    for (TrackPoint& point : track_) {
      const auto now = geometry::rotate_pixel(camera, to_eigen(point.center_px), *angular_velocity_rad_s, dt_s);
      point.center_px = {now.x(), now.y()};
    }
  }
  if (result.steps.status == MapStatus::kOk) {
    result.region = choose(result.steps, time_s);
  }
  if (!result.region) {
    if (!track_.empty() && time_s - track_.back().time_s > options_.max_miss_s) {
      track_.clear();
    }
    result.track = track_;
    return result;
  }
  result.mask = obstacle_mask(result.steps, *result.region, options_.convex);
  const TrackPoint point = measure(result.mask, time_s);
  const double gate_px = options_.gate * std::hypot(map.cols, map.rows);
  if (!track_.empty() && cv::norm(point.center_px - track_.back().center_px) > gate_px) {
    track_.clear();  // another thing
  }
  track_.push_back(point);
  while (static_cast<int>(track_.size()) > options_.confirm_frames && time_s - track_[1].time_s >= options_.confirm_s) {
    track_.erase(track_.begin());
  }
  result.track = track_;
  result.status = DodgeStatus::kDetected;
  if (const Motion motion(track_); confirmed(motion, map.size())) {
    predict(motion, result, map.size());
  }
  return result;
}

bool DodgePipeline::confirmed(const Motion& motion, const cv::Size& size) const {
  if (static_cast<int>(track_.size()) < options_.confirm_frames) {
    return false;
  }
  const double span_s = track_.back().time_s - track_.front().time_s;
  const double moved_px = std::hypot(motion.x.slope, motion.y.slope) * span_s;
  return span_s >= options_.confirm_s || moved_px > options_.min_move * size.height;
}

void DodgePipeline::predict(const Motion& motion, DodgeResult& result, const cv::Size& size) const {
  const LineFit& diameter = motion.diameter;
  result.velocity_px_s = {motion.x.slope, motion.y.slope};
  const double growth_per_s = diameter.last > 0.0 ? diameter.slope / diameter.last : 0.0;  // 1 / t_c
  result.contact_from_growth = growth_per_s >= options_.min_growth_per_s;
  result.time_to_contact_s =
      result.contact_from_growth ? std::min(1.0 / growth_per_s, 2.0 * options_.horizon_s) : options_.horizon_s;
  const Eigen::Vector2d center(0.5 * (size.width - 1), 0.5 * (size.height - 1));
  const Eigen::Vector2d miss = result.time_to_contact_s * result.velocity_px_s;
  result.impact_px = center + miss;
  const Eigen::Vector2d counted(1.0, options_.vertical);
  Eigen::Vector2d away = -miss.cwiseProduct(counted);
  if (away.norm() < options_.direct_hit * size.height) {
    // A direct hit has no side. Across the line of sight, away from where the thing is; straight ahead: to the right.
    const Eigen::Vector2d seen = (Eigen::Vector2d(motion.x.last, motion.y.last) - center).cwiseProduct(counted);
    away = seen.norm() < 1.0 ? Eigen::Vector2d::UnitX() : Eigen::Vector2d(-seen);
  }
  result.safe_direction = away.normalized();
  result.status = DodgeStatus::kIncoming;
}

}  // namespace ajna::tasks
