// SPDX-License-Identifier: MIT
#include "ajna/tasks/horizon.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/base/range.hpp"
#include "ajna/geometry/camera.hpp"

namespace ajna::tasks {
namespace {

/// Rows of a column that lie in the band about the horizon, and the horizon's own.
struct Band {
  double horizon_row;
  int wanted;  ///< rows of the whole band, those outside of the image included
  int first;
  int last;
};

std::optional<Band> band_of(const geometry::Camera& camera, const Eigen::Matrix3d& rotation, double x, double slope) {
  const double u = (x - camera.cx) / camera.fx;
  // The ray through row v leads down by r20 u + r21 v + r22 (in units of depth): 0 on the horizon.
  const double per_v = rotation(2, 1);
  if (std::abs(per_v) < 0.2) {
    return std::nullopt;  // the camera lies on its side
  }
  const double v = -(rotation(2, 0) * u + rotation(2, 2)) / per_v;
  const Eigen::Vector3d ray = rotation * Eigen::Vector3d(u, v, 1.0);
  const double half = slope * std::hypot(ray.x(), ray.y()) / std::abs(per_v) * camera.fy;
  const double row = camera.cy + v * camera.fy;
  Band band{row, static_cast<int>(2.0 * half) + 1, std::max(0, static_cast<int>(std::ceil(row - half))),
            std::min(camera.height - 1, static_cast<int>(std::floor(row + half)))};
  return band.first <= band.last ? std::optional(band) : std::nullopt;
}

}  // namespace

void validate(const HorizonOptions& options) {
  require_between("navigate options: horizon.band", options.band, 0.01, 1.0);
  require_between("navigate options: horizon.floor", options.floor, 0.0, 100.0);
  require_between("navigate options: horizon.per_px", options.per_px, 1e-4, 100.0);
  require_between("navigate options: horizon.least_shift_px", options.least_shift_px, 0.0, 1000.0);
  require_between("navigate options: horizon.max_distance_m", options.max_distance_m, 1.0, 1000.0);
  require_between("navigate options: horizon.min_move_m", options.min_move_m, 1e-3, 10.0);
  require_between("navigate options: horizon.column_step", options.column_step, 1, 64);
}

std::optional<Obstacles> horizon_obstacles(const cv::Mat& map, const cv::Mat& valid,
                                           const Eigen::Matrix3d& heading_from_camera, double horizontal_fov_rad,
                                           const Eigen::Vector3d& move_m, const HorizonOptions& options) {
  validate(options);
  if (map.empty() || map.type() != CV_32F) {
    throw_invalid("horizon: give a scalar map of uncertainty, float32 [H, W]");
  }
  if (!valid.empty() && (valid.type() != CV_8U || valid.size() != map.size())) {
    throw_invalid("horizon: give a mask of valid pixels of the map's size, uint8 [H, W]");
  }
  const double move = move_m.norm();
  const auto camera = geometry::Camera::from_horizontal_fov(map.cols, map.rows, horizontal_fov_rad);
  const auto focus = move >= options.min_move_m ? camera.project(heading_from_camera.transpose() * move_m)
                                                : std::optional<Eigen::Vector2d>();
  if (!focus) {
    return std::nullopt;
  }
  Obstacles obstacles;
  int columns = 0;
  int seen = 0;
  for (int x = 0; x < map.cols; x += options.column_step) {
    ++columns;
    const auto band = band_of(camera, heading_from_camera, x, options.band);
    if (!band) {
      continue;
    }
    double sum = 0.0;
    int count = 0;
    for (int y = band->first; y <= band->last; ++y) {
      if (valid.empty() || valid.at<std::uint8_t>(y, x) != 0) {
        sum += static_cast<double>(map.at<float>(y, x));
        ++count;
      }
    }
    if (count == 0 || 2 * count < band->wanted) {
      continue;
    }
    ++seen;
    const double excess = sum / count - options.floor;
    const Eigen::Vector2d pixel(x, band->horizon_row);
    const double depth = excess > 0.0
                             ? options.per_px * ((pixel - *focus).norm() + options.least_shift_px) * move / excess
                             : std::numeric_limits<double>::infinity();
    const Eigen::Vector2d normalized = camera.normalize(pixel);
    const Eigen::Vector3d ray = heading_from_camera * Eigen::Vector3d(normalized.x(), normalized.y(), 1.0);
    if (depth * ray.head<2>().norm() <= options.max_distance_m) {
      obstacles.emplace_back(depth * ray.x(), depth * ray.y());
    }
  }
  return 2 * seen >= columns ? std::optional(obstacles) : std::nullopt;
}

void validate(const CorridorOptions& options) {
  require_between("navigate options: corridor.half_width_m", options.half_width_m, 0.05, 10.0);
  require_between("navigate options: corridor.room_m", options.room_m, 0.0, 10.0);
  require_between("navigate options: corridor.fan_rad", options.fan_rad, 0.05, 1.5);
  require_between("navigate options: corridor.directions", options.directions, 3, 1001);
  require_between("navigate options: corridor.horizon_m", options.horizon_m, 1.0, 1000.0);
  require_between("navigate options: corridor.remember_m", options.remember_m, 0.0, 1000.0);
  require_between("navigate options: corridor.remember_s", options.remember_s, 0.0, 10.0);
  require_between("navigate options: corridor.remember_move_m", options.remember_move_m, 0.0, 100.0);
  require_between("navigate options: corridor.stay_m", options.stay_m, 0.0, 100.0);
  require_between("navigate options: corridor.support", options.support, 1, 1000);
  require_between("navigate options: corridor.room_weight", options.room_weight, 0.0, 10.0);
  require_between("navigate options: corridor.goal_weight", options.goal_weight, 0.0, 10.0);
  require_between("navigate options: corridor.keep_weight", options.keep_weight, 0.0, 10.0);
  require_between("navigate options: corridor.need_m", options.need_m, 0.1, 100.0);
  require_between("navigate options: corridor.need_weight", options.need_weight, 0.0, 10.0);
  require_between("navigate options: corridor.brake_m_s2", options.brake_m_s2, 0.1, 50.0);
  require_between("navigate options: corridor.stop_m", options.stop_m, 0.0, 10.0);
}

CorridorPlanner::CorridorPlanner(const CorridorOptions& options) : options_(options) { validate(options); }

void CorridorPlanner::reset() noexcept {
  memory_.clear();
  last_rad_.reset();
}

double CorridorPlanner::free_length(const Obstacles& obstacles, double angle_rad, double half_width_m) const {
  constexpr double kBeside_m = 0.2;  // behind the camera's plane, but still beside the vehicle
  const Eigen::Vector2d ahead(std::cos(angle_rad), std::sin(angle_rad));
  std::vector<double> blocked_at;
  for (const auto& thing : obstacles) {
    const double along = ahead.dot(thing);
    const double across = std::abs(ahead.x() * thing.y() - ahead.y() * thing.x());
    if (across < half_width_m && along > -kBeside_m && along < options_.horizon_m) {
      blocked_at.push_back(std::max(along, 0.0));
    }
  }
  if (blocked_at.size() < static_cast<std::size_t>(options_.support)) {
    return options_.horizon_m;
  }
  const auto nth = blocked_at.begin() + (options_.support - 1);
  std::nth_element(blocked_at.begin(), nth, blocked_at.end());
  return *nth;
}

Corridor CorridorPlanner::plan(const Obstacles& obstacles, double time_s, const Eigen::Vector2d& position_m,
                               double yaw_rad, double goal_rad) {
  Eigen::Matrix2d fixed_from_heading;
  fixed_from_heading << std::cos(yaw_rad), -std::sin(yaw_rad), std::sin(yaw_rad), std::cos(yaw_rad);
  const auto forgotten = [&](const Seen& seen) {
    const double moved_m = (position_m - seen.from_m).norm();
    return moved_m > options_.remember_move_m ||
           (time_s - seen.time_s > options_.remember_s && moved_m > options_.stay_m);
  };
  while (!memory_.empty() && forgotten(memory_.front())) {
    memory_.pop_front();
  }
  Obstacles all = obstacles;
  for (const auto& seen : memory_) {
    for (const auto& thing : seen.at_m) {
      all.emplace_back(fixed_from_heading.transpose() * (thing - position_m));
    }
  }
  Seen now{time_s, position_m, {}};
  Corridor best;
  best.close_m = options_.horizon_m;
  for (const auto& thing : obstacles) {
    const double distance = thing.norm();
    if (distance < options_.remember_m) {
      now.at_m.emplace_back(position_m + fixed_from_heading * thing);
    }
    if (std::abs(std::atan2(thing.y(), thing.x())) <= options_.fan_rad) {
      best.close_m = std::min(best.close_m, distance);
    }
  }
  memory_.push_back(std::move(now));

  const double goal = std::clamp(goal_rad, -M_PI / 2, M_PI / 2);
  const double last = last_rad_ ? std::remainder(*last_rad_ - yaw_rad, 2.0 * M_PI) : goal;
  double best_score = -std::numeric_limits<double>::infinity();
  for (int i = 0; i < options_.directions; ++i) {
    const double angle = options_.fan_rad * (2.0 * i / (options_.directions - 1) - 1.0);
    const double narrow = free_length(all, angle, options_.half_width_m);
    const double wide = free_length(all, angle, options_.half_width_m + options_.room_m);
    const double score = (narrow + options_.room_weight * wide) / options_.horizon_m -
                         options_.goal_weight * std::abs(angle - goal) - options_.keep_weight * std::abs(angle - last) -
                         options_.need_weight * std::max(0.0, 1.0 - narrow / options_.need_m);
    if (score > best_score) {
      best_score = score;
      best.angle_rad = angle;
      best.free_m = narrow;
    }
  }
  best.goal_free_m = free_length(all, goal, options_.half_width_m);
  best.speed_m_s = std::sqrt(2.0 * options_.brake_m_s2 * std::max(best.free_m - options_.stop_m, 0.0));
  last_rad_ = yaw_rad + best.angle_rad;
  return best;
}

}  // namespace ajna::tasks
