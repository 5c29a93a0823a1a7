// SPDX-License-Identifier: MIT
#include "ajna/tasks/corridor.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "ajna/base/range.hpp"

namespace ajna::tasks {
namespace {

constexpr double kPixel_m = 0.1;   // of the picture of clearances
constexpr double kBehind_m = 1.0;  // behind the camera's plane, but still beside the vehicle

}  // namespace

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
  require_between("navigate options: corridor.crowd_weight", options.crowd_weight, 0.0, 100.0);
  require_between("navigate options: corridor.camera_ahead_m", options.camera_ahead_m, -2.0, 2.0);
  require_between("navigate options: corridor.brake_m_s2", options.brake_m_s2, 0.1, 50.0);
  require_between("navigate options: corridor.stop_m", options.stop_m, 0.0, 10.0);
  require_between("navigate options: corridor.lag_s", options.lag_s, 0.0, 2.0);
  require_between("navigate options: corridor.turn_per_s", options.turn_per_s, 0.1, 100.0);
  require_between("navigate options: corridor.turn_m_s2", options.turn_m_s2, 0.1, 1000.0);
}

CorridorPlanner::CorridorPlanner(const CorridorOptions& options, const OccupancyOptions& map)
    : options_(options), map_(map), cell_m_(map.cell_m) {
  validate(options);
}

void CorridorPlanner::reset() noexcept {
  map_.reset();
  things_.clear();
  last_rad_.reset();
}

double CorridorPlanner::clearance(const Eigen::Vector2d& point_m) const {
  const int row = cvRound((point_m.y() + options_.horizon_m) / kPixel_m);
  const int column = cvRound((point_m.x() + kBehind_m) / kPixel_m);
  const bool known = row >= 0 && row < clearance_.rows && column >= 0 && column < clearance_.cols;
  return known ? static_cast<double>(clearance_.at<float>(row, column)) : options_.horizon_m;
}

void CorridorPlanner::measure() {
  const int rows = cvCeil(2.0 * options_.horizon_m / kPixel_m) + 1;
  const int columns = cvCeil((options_.horizon_m + kBehind_m) / kPixel_m) + 1;
  cv::Mat away(rows, columns, CV_8U, cv::Scalar(255));
  bool any = false;
  for (const auto& thing : things_) {
    const auto beside = std::count_if(things_.begin(), things_.end(), [&](const Eigen::Vector2d& other) {
      return (other - thing).cwiseAbs().maxCoeff() < 1.6 * cell_m_;  // in any direction of the map's turned grid
    });
    const int row = cvRound((thing.y() + options_.horizon_m) / kPixel_m);
    const int column = cvRound((thing.x() + kBehind_m) / kPixel_m);
    if (beside >= options_.support && row >= 0 && row < rows && column >= 0 && column < columns) {
      away.at<std::uint8_t>(row, column) = 0;
      any = true;
    }
  }
  if (any) {
    cv::distanceTransform(away, clearance_, cv::DIST_L2, cv::DIST_MASK_5);
    clearance_ *= kPixel_m;
  } else {
    clearance_ = cv::Mat(rows, columns, CV_32F, cv::Scalar(options_.horizon_m));
  }
}

CorridorPlanner::Free CorridorPlanner::free_length(double angle_rad, const Eigen::Vector2d& velocity_m_s) const {
  constexpr double kStep_m = 0.15;
  constexpr double kSlowest_m_s = 2.0;  // a vehicle at rest turns on the spot; the way is what counts
  constexpr double kNearer_m = 0.05;    // what is near already blocks where the way leads nearer by so much
  const double speed = std::max(velocity_m_s.norm(), kSlowest_m_s);
  const double dt_s = kStep_m / speed;
  const Eigen::Vector2d wanted = speed * Eigen::Vector2d(std::cos(angle_rad), std::sin(angle_rad));
  Eigen::Vector2d velocity = velocity_m_s;
  Eigen::Vector2d at(-options_.camera_ahead_m, 0.0);
  double reached = clearance(at);
  double along = 0.0;
  Free free{options_.horizon_m, options_.horizon_m};
  const double wide = options_.half_width_m + options_.room_m;
  for (double time_s = dt_s; along < options_.horizon_m; time_s += dt_s) {
    if (time_s > options_.lag_s) {
      Eigen::Vector2d change = options_.turn_per_s * (wanted - velocity);
      change *= std::min(1.0, options_.turn_m_s2 / std::max(change.norm(), 1e-9));
      velocity += dt_s * change;
    }
    at += dt_s * velocity;
    along += dt_s * std::max(velocity.norm(), 0.3 * speed);
    const double here = clearance(at);
    reached = std::max(reached, here);
    if (along <= options_.need_m) {
      const double taken = std::max(0.0, 1.0 - here / wide);
      free.crowd += taken * taken * kStep_m / options_.need_m;
    }
    if (here < std::min(wide, reached - kNearer_m)) {
      free.wide_m = std::min(free.wide_m, along);
    }
    if (here < std::min(options_.half_width_m, reached - kNearer_m)) {
      free.narrow_m = along;
      break;
    }
  }
  return free;
}

Corridor CorridorPlanner::plan(const std::optional<HorizonScan>& scan, const Eigen::Vector2d& position_m,
                               double yaw_rad, double goal_rad, const Eigen::Vector2d& velocity_m_s) {
  if (scan) {
    map_.add(*scan, position_m, yaw_rad);
  }
  things_ = map_.things(position_m, yaw_rad);
  measure();
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
    const Free free = free_length(angle, velocity_m_s);
    const double score = (free.narrow_m + options_.room_weight * free.wide_m) / options_.horizon_m -
                         options_.goal_weight * std::abs(angle - goal) - options_.keep_weight * std::abs(angle - last) -
                         options_.need_weight * std::max(0.0, 1.0 - free.narrow_m / options_.need_m) -
                         options_.crowd_weight * free.crowd;
    if (score > best_score) {
      best_score = score;
      best.angle_rad = angle;
      best.free_m = free.narrow_m;
    }
  }
  best.goal_free_m = free_length(goal, velocity_m_s).narrow_m;
  best.speed_m_s = std::sqrt(2.0 * options_.brake_m_s2 * std::max(best.free_m - options_.stop_m, 0.0));
  last_rad_ = yaw_rad + best.angle_rad;
  return best;
}

}  // namespace ajna::tasks
