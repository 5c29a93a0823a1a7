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
constexpr double kResting_m_s = 0.5;

}  // namespace

void validate(const CorridorOptions& options) {
  require_between("navigate options: corridor.half_width_m", options.half_width_m, 0.05, 10.0);
  require_between("navigate options: corridor.bare_m", options.bare_m, 0.05, options.half_width_m);
  require_between("navigate options: corridor.squeeze_m_s", options.squeeze_m_s, 0.0, 10.0);
  require_between("navigate options: corridor.bare_weight", options.bare_weight, 0.0, 10.0);
  require_between("navigate options: corridor.room_m", options.room_m, 0.0, 10.0);
  require_between("navigate options: corridor.fan_rad", options.fan_rad, 0.05, 1.5);
  require_between("navigate options: corridor.directions", options.directions, 3, 1001);
  require_between("navigate options: corridor.blocked_m", options.blocked_m, 0.0, 100.0);
  require_between("navigate options: corridor.wide_fan_rad", options.wide_fan_rad, 0.05, M_PI);
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
  const double y = (point_m.y() + options_.horizon_m) / kPixel_m;
  const double x = (point_m.x() + kBehind_m) / kPixel_m;
  const int row = cvFloor(y);
  const int column = cvFloor(x);
  if (row < 0 || row + 1 >= clearance_.rows || column < 0 || column + 1 >= clearance_.cols) {
    return options_.horizon_m;
  }
  const auto at = [&](int down, int right) {
    return static_cast<double>(clearance_.at<float>(row + down, column + right));
  };
  const double right = x - column;
  const double down = y - row;
  return (1.0 - down) * ((1.0 - right) * at(0, 0) + right * at(0, 1)) +
         down * ((1.0 - right) * at(1, 0) + right * at(1, 1));
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
  const bool resting = velocity_m_s.norm() < kResting_m_s;
  double reached = clearance(at);
  double along = 0.0;
  Free free{options_.horizon_m, options_.horizon_m, options_.horizon_m};
  const double wide = options_.half_width_m + options_.room_m;
  for (double time_s = dt_s; along < options_.horizon_m; time_s += dt_s) {
    const bool turning = time_s > options_.lag_s;
    if (turning) {
      Eigen::Vector2d change = options_.turn_per_s * (wanted - velocity);
      change *= std::min(1.0, options_.turn_m_s2 / std::max(change.norm(), 1e-9));
      velocity += dt_s * change;
    }
    at += dt_s * velocity;
    along += dt_s * std::max(velocity.norm(), 0.3 * speed);
    const double here = clearance(at);
    // A vehicle that hardly moves drifts nearer by some centimetres, whatever is chosen: that must not block all ways.
    reached = resting && !turning ? here : std::max(reached, here);
    if (along <= options_.need_m) {
      const double taken = std::max(0.0, 1.0 - here / wide);
      free.crowd += taken * taken * kStep_m / options_.need_m;
    }
    const double nearer = reached - kNearer_m;
    const auto end = [&](double width_m, double& length_m) {
      if (here < std::min(width_m, nearer)) {
        length_m = std::min(length_m, along);
      }
    };
    end(wide, free.wide_m);
    end(options_.half_width_m, free.narrow_m);
    end(options_.bare_m, free.bare_m);
    if (free.bare_m <= along) {
      free.crowd += std::max(0.0, 1.0 - along / options_.need_m);  // nor is there room behind it
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
  const auto consider = [&](double angle) {
    const Free free = free_length(angle, velocity_m_s);
    const double score = (free.narrow_m + options_.room_weight * free.wide_m) / options_.horizon_m -
                         options_.goal_weight * std::abs(angle - goal) - options_.keep_weight * std::abs(angle - last) -
                         options_.need_weight * std::max(0.0, 1.0 - free.narrow_m / options_.need_m) -
                         options_.bare_weight * std::max(0.0, 1.0 - free.bare_m / options_.need_m) -
                         options_.crowd_weight * free.crowd;
    if (score > best_score) {
      best_score = score;
      best.angle_rad = angle;
      best.free_m = free.narrow_m;
      best.bare_m = free.bare_m;
    }
  };
  const double step = 2.0 * options_.fan_rad / (options_.directions - 1);
  for (int i = 0; i < options_.directions; ++i) {
    consider(i * step - options_.fan_rad);
  }
  if (best.free_m < options_.blocked_m && velocity_m_s.norm() < kResting_m_s) {
    for (double angle = options_.fan_rad + step; angle <= options_.wide_fan_rad; angle += step) {
      consider(angle);
      consider(-angle);
    }
  }
  best.goal_free_m = free_length(goal, velocity_m_s).narrow_m;
  const auto braked = [&](double within_m) {
    return std::sqrt(2.0 * options_.brake_m_s2 * std::max(within_m - options_.stop_m, 0.0));
  };
  best.speed_m_s = std::max(braked(best.free_m), std::min(braked(best.bare_m), options_.squeeze_m_s));
  last_rad_ = yaw_rad + best.angle_rad;
  return best;
}

}  // namespace ajna::tasks
