// SPDX-License-Identifier: MIT
#include "ajna/tasks/corridor.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "ajna/base/range.hpp"
#include "ajna/tasks/bilinear.hpp"

namespace ajna::tasks {
namespace {

constexpr double kPixel_m = 0.1;   // of the picture of clearances
constexpr double kBehind_m = 1.0;  // behind the camera's plane, but still beside the vehicle
constexpr double kResting_m_s = 0.5;

const CorridorOptions& validated(const CorridorOptions& options) {
  validate(options);
  return options;
}

}  // namespace

void validate(const CorridorOptions& options) {
  require_between("navigate options: corridor.half_width_m", options.half_width_m, 0.05, 10.0);
  require_between("navigate options: corridor.bare_m", options.bare_m, 0.05, options.half_width_m);
  require_between("navigate options: corridor.squeeze_m_s", options.squeeze_m_s, 0.0, 10.0);
  require_between("navigate options: corridor.room_m", options.room_m, 0.0, 10.0);
  require_between("navigate options: corridor.fan_rad", options.fan_rad, 0.05, 1.5);
  require_between("navigate options: corridor.directions", options.directions, 3, 1001);
  require_between("navigate options: corridor.blocked_m", options.blocked_m, 0.0, 100.0);
  require_between("navigate options: corridor.wide_fan_rad", options.wide_fan_rad, 0.05, M_PI);
  require_between("navigate options: corridor.horizon_m", options.horizon_m, 1.0, 100.0);
  require_between("navigate options: corridor.support", options.support, 1, 1000);
  require_between("navigate options: corridor.keep_weight", options.keep_weight, 0.0, 100.0);
  require_between("navigate options: corridor.aside_rad", options.aside_rad, 0.0, 0.99 * options.fan_rad);
  require_between("navigate options: corridor.blocked_weight", options.blocked_weight, 0.0, 1000.0);
  require_between("navigate options: corridor.goal_ahead_m", options.goal_ahead_m, 1.0, 1000.0);
  require_between("navigate options: corridor.side_m", options.side_m, 1.0, 30.0);
  require_between("navigate options: corridor.least_way_m", options.least_way_m, 0.1, 10.0);
  require_between("navigate options: corridor.least_way_s", options.least_way_s, 0.0, 5.0);
  require_between("navigate options: corridor.need_m", options.need_m, 0.1, 100.0);
  require_between("navigate options: corridor.crowd_weight", options.crowd_weight, 0.0, 100.0);
  require_between("navigate options: corridor.camera_ahead_m", options.camera_ahead_m, -2.0, 2.0);
  require_between("navigate options: corridor.brake_m_s2", options.brake_m_s2, 0.1, 50.0);
  require_between("navigate options: corridor.stop_m", options.stop_m, 0.0, 10.0);
  require_between("navigate options: corridor.lag_s", options.lag_s, 0.0, 2.0);
  require_between("navigate options: corridor.turn_per_s", options.turn_per_s, 0.1, 100.0);
  require_between("navigate options: corridor.turn_m_s2", options.turn_m_s2, 0.1, 1000.0);
}

CorridorPlanner::CorridorPlanner(const CorridorOptions& options, const OccupancyOptions& map)
    : options_(validated(options)),
      map_(map),
      cell_m_(map.cell_m),
      to_go_(kBehind_m, options.horizon_m, options.side_m) {}

void CorridorPlanner::reset() noexcept {
  map_.reset();
  things_.clear();
  last_rad_.reset();
}

double CorridorPlanner::clearance(const Eigen::Vector2d& point_m) const {
  const double y = (point_m.y() + options_.horizon_m) / kPixel_m;
  const double x = (point_m.x() + kBehind_m) / kPixel_m;
  const bool inside = y >= 0.0 && y < clearance_.rows - 1 && x >= 0.0 && x < clearance_.cols - 1;
  return inside ? bilinear(clearance_, y, x) : options_.horizon_m;
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

double CorridorPlanner::cost(double clearance_m) const {
  constexpr double kEdge_m = 0.1;
  const double taken = std::max(0.0, 1.0 - clearance_m / (options_.half_width_m + options_.room_m));
  const double blocked = std::clamp((options_.bare_m + kEdge_m - clearance_m) / kEdge_m, 0.0, 1.0);
  return 1.0 + options_.crowd_weight * taken * taken + options_.blocked_weight * blocked;
}

void CorridorPlanner::solve(double goal_rad) {
  cv::Mat costs(to_go_.rows(), to_go_.columns(), CV_32F);
  for (int row = 0; row < costs.rows; ++row) {
    for (int column = 0; column < costs.cols; ++column) {
      costs.at<float>(row, column) = static_cast<float>(cost(clearance(to_go_.node(row, column))));
    }
  }
  to_go_.solve(costs, options_.goal_ahead_m * Eigen::Vector2d(std::cos(goal_rad), std::sin(goal_rad)));
}

double CorridorPlanner::least_way_m(const CorridorStart& start) const {
  return options_.least_way_m + options_.least_way_s * start.velocity_m_s.norm();
}

Eigen::Vector2d CorridorPlanner::middle_m(const CorridorStart& start) const {
  return start.moved_m - Eigen::Vector2d(options_.camera_ahead_m, 0.0);
}

CorridorPlanner::Way CorridorPlanner::roll(double angle_rad, double hold_m, double end_m,
                                           const CorridorStart& start) const {
  constexpr double kStep_m = 0.15;
  constexpr double kSlowest_m_s = 2.0;  // a vehicle at rest turns on the spot; the way is what counts
  constexpr double kNearer_m = 0.05;    // what is near already blocks where the way leads nearer by so much
  constexpr double kBetter_m = 0.02;
  const double speed = std::max(start.velocity_m_s.norm(), kSlowest_m_s);
  const double dt_s = kStep_m / speed;
  const double least_m = least_way_m(start);
  const bool resting = start.velocity_m_s.norm() < kResting_m_s;
  Eigen::Vector2d wanted = speed * Eigen::Vector2d(std::cos(angle_rad), std::sin(angle_rad));
  Eigen::Vector2d velocity = start.velocity_m_s;
  Eigen::Vector2d at = middle_m(start);
  double reached = clearance(at);
  double along = 0.0;
  double spent = 0.0;
  Way way{std::numeric_limits<double>::infinity(), 0.0, end_m, end_m};
  for (double time_s = dt_s; along < end_m; time_s += dt_s) {
    const bool turning = time_s > options_.lag_s;
    if (along > hold_m) {
      wanted = speed * to_go_.downhill(at);
    }
    if (turning) {
      Eigen::Vector2d change = options_.turn_per_s * (wanted - velocity);
      change *= std::min(1.0, options_.turn_m_s2 / std::max(change.norm(), 1e-9));
      velocity += dt_s * change;
    }
    at += dt_s * velocity;
    const double step = dt_s * std::max(velocity.norm(), 0.3 * speed);
    along += step;
    const double here = clearance(at);
    spent += step * cost(here);
    const double total = spent + to_go_.at(at);
    if (along >= least_m && total < way.cost - kBetter_m) {
      way.cost = total;
      way.best_m = along;
    }
    // A vehicle that hardly moves drifts nearer by some centimetres, whatever is chosen: that must not block all ways.
    reached = resting && !turning ? here : std::max(reached, here);
    const double nearer = reached - kNearer_m;
    if (here < std::min(options_.half_width_m, nearer)) {
      way.narrow_m = std::min(way.narrow_m, along);
    }
    if (here < std::min(options_.bare_m, nearer)) {
      way.bare_m = along;
      if (along < least_m) {
        way.cost = total + (least_m - along) * cost(0.0);
        way.best_m = along;
      }
      break;
    }
  }
  return way;
}

double CorridorPlanner::speed_for(const Corridor& corridor, const CorridorStart& start) const {
  // It flies on for a while before it brakes: within_m = v t + v^2 / 2 a.
  const double late_m_s = options_.brake_m_s2 * (options_.lag_s + 1.0 / options_.turn_per_s);
  const auto braked = [&](double within_m) {
    const double room_m = std::max(within_m - options_.stop_m, 0.0);
    return std::sqrt(late_m_s * late_m_s + 2.0 * options_.brake_m_s2 * room_m) - late_m_s;
  };
  double speed = std::max(braked(corridor.free_m), std::min(braked(corridor.bare_m), options_.squeeze_m_s));
  constexpr double kTouching_m = 0.05;
  if (clearance(middle_m(start)) < options_.bare_m + kTouching_m) {
    speed = std::min(speed, options_.squeeze_m_s);
  }
  // What lies aside has not been seen yet: there it speeds up the less the further aside it is.
  const double aside = std::clamp(
      (std::abs(corridor.angle_rad) - options_.aside_rad) / (options_.fan_rad - options_.aside_rad), 0.0, 1.0);
  const double kept = std::max(start.velocity_m_s.norm(), options_.squeeze_m_s);
  return std::min(speed, kept + (1.0 - aside) * std::max(0.0, braked(options_.horizon_m) - kept));
}

Corridor CorridorPlanner::plan(const std::optional<HorizonScan>& scan, const Eigen::Vector2d& position_m,
                               double yaw_rad, double goal_rad, const CorridorStart& start) {
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
  solve(goal);
  double best_cost = std::numeric_limits<double>::infinity();
  double best_m = 0.0;
  const double longest_m = std::max(options_.need_m, least_way_m(start));
  const auto consider = [&](double angle) {
    const Way way = roll(angle, longest_m, longest_m, start);
    const double cost = way.cost + options_.keep_weight * std::abs(angle - last);
    if (cost < best_cost) {
      best_cost = cost;
      best.angle_rad = angle;
      best_m = way.best_m;
    }
  };
  const auto follow = [&] {
    const Way way = roll(best.angle_rad, best_m, options_.horizon_m, start);
    best.free_m = way.narrow_m;
    best.bare_m = way.bare_m;
  };
  const double step = 2.0 * options_.fan_rad / (options_.directions - 1);
  for (int i = 0; i < options_.directions; ++i) {
    consider(i * step - options_.fan_rad);
  }
  follow();
  if (best.free_m < options_.blocked_m && start.velocity_m_s.norm() < kResting_m_s) {
    for (double angle = options_.fan_rad + step; angle <= options_.wide_fan_rad; angle += step) {
      consider(angle);
      consider(-angle);
    }
    follow();
  }
  best.goal_free_m = roll(goal, options_.horizon_m, options_.horizon_m, start).narrow_m;
  best.speed_m_s = speed_for(best, start);
  last_rad_ = yaw_rad + best.angle_rad;
  return best;
}

}  // namespace ajna::tasks
