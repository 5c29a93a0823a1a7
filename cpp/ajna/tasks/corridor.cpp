// SPDX-License-Identifier: MIT
#include "ajna/tasks/corridor.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "ajna/base/range.hpp"

namespace ajna::tasks {

void validate(const CorridorOptions& options) {
  require_between("navigate options: corridor.half_width_m", options.half_width_m, 0.05, 10.0);
  require_between("navigate options: corridor.room_m", options.room_m, 0.0, 10.0);
  require_between("navigate options: corridor.fan_rad", options.fan_rad, 0.05, 1.5);
  require_between("navigate options: corridor.directions", options.directions, 3, 1001);
  require_between("navigate options: corridor.horizon_m", options.horizon_m, 1.0, 1000.0);
  require_between("navigate options: corridor.support", options.support, 1, 1000);
  require_between("navigate options: corridor.room_weight", options.room_weight, 0.0, 10.0);
  require_between("navigate options: corridor.goal_weight", options.goal_weight, 0.0, 10.0);
  require_between("navigate options: corridor.keep_weight", options.keep_weight, 0.0, 10.0);
  require_between("navigate options: corridor.need_m", options.need_m, 0.1, 100.0);
  require_between("navigate options: corridor.need_weight", options.need_weight, 0.0, 10.0);
  require_between("navigate options: corridor.brake_m_s2", options.brake_m_s2, 0.1, 50.0);
  require_between("navigate options: corridor.stop_m", options.stop_m, 0.0, 10.0);
}

CorridorPlanner::CorridorPlanner(const CorridorOptions& options, const OccupancyOptions& map)
    : options_(options), map_(map) {
  validate(options);
}

void CorridorPlanner::reset() noexcept {
  map_.reset();
  things_.clear();
  last_rad_.reset();
}

double CorridorPlanner::free_length(double angle_rad, double half_width_m) const {
  constexpr double kBeside_m = 0.2;  // behind the camera's plane, but still beside the vehicle
  const Eigen::Vector2d ahead(std::cos(angle_rad), std::sin(angle_rad));
  std::vector<double> blocked_at;
  for (const auto& thing : things_) {
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

Corridor CorridorPlanner::plan(const std::optional<HorizonScan>& scan, const Eigen::Vector2d& position_m,
                               double yaw_rad, double goal_rad) {
  if (scan) {
    map_.add(*scan, position_m, yaw_rad);
  }
  things_ = map_.things(position_m, yaw_rad);
  Corridor best;
  best.close_m = options_.horizon_m;
  for (const auto& thing : things_) {
    if (std::abs(std::atan2(thing.y(), thing.x())) <= options_.fan_rad) {
      best.close_m = std::min(best.close_m, thing.norm());
    }
  }

  const double goal = std::clamp(goal_rad, -M_PI / 2, M_PI / 2);
  const double last = last_rad_ ? std::remainder(*last_rad_ - yaw_rad, 2.0 * M_PI) : goal;
  double best_score = -std::numeric_limits<double>::infinity();
  for (int i = 0; i < options_.directions; ++i) {
    const double angle = options_.fan_rad * (2.0 * i / (options_.directions - 1) - 1.0);
    const double narrow = free_length(angle, options_.half_width_m);
    const double wide = free_length(angle, options_.half_width_m + options_.room_m);
    const double score = (narrow + options_.room_weight * wide) / options_.horizon_m -
                         options_.goal_weight * std::abs(angle - goal) - options_.keep_weight * std::abs(angle - last) -
                         options_.need_weight * std::max(0.0, 1.0 - narrow / options_.need_m);
    if (score > best_score) {
      best_score = score;
      best.angle_rad = angle;
      best.free_m = narrow;
    }
  }
  best.goal_free_m = free_length(goal, options_.half_width_m);
  best.speed_m_s = std::sqrt(2.0 * options_.brake_m_s2 * std::max(best.free_m - options_.stop_m, 0.0));
  last_rad_ = yaw_rad + best.angle_rad;
  return best;
}

}  // namespace ajna::tasks
