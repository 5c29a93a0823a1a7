// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>

#include "ajna/tasks/horizon.hpp"
#include "ajna/tasks/occupancy.hpp"

namespace ajna::tasks {

struct CorridorOptions {
  double half_width_m = 0.45;  ///< of the corridor that must be free: vehicle, and room on both sides
  double bare_m = 0.3;         ///< half the vehicle's own width: where there is no more, it flies slowly ...
  double squeeze_m_s = 1.0;    ///< ... at no more than this
  double room_m = 0.3;         ///< more of it on both sides is better
  double fan_rad = 0.7;        ///< directions are looked at up to so far to both sides
  int directions = 81;         ///< in that fan
  double blocked_m = 1.0;      ///< where no direction of it is free for so long, and the vehicle hardly moves ...
  double wide_fan_rad = 1.6;   ///< ... they are looked at up to so far
  double horizon_m = 9.0;      ///< free further than this is no better
  int support = 2;             ///< so many cells of the map must stand side by side to count
  double room_weight = 0.35;   ///< of the wider corridor's length against the narrow one's, both over horizon_m
  double goal_weight = 0.4;    ///< of the angle to the goal, per radian
  double keep_weight = 0.3;    ///< of the angle to the last choice, per radian: what is turned back from halfway is hit
  double need_m = 3.5;         ///< what is free for less ...
  double need_weight = 1.5;    ///< ... loses by so much times the missing share
  double bare_weight = 1.5;    ///< likewise of the vehicle's own width
  double crowd_weight = 2.0;   ///< of how near things stand to the way, over need_m of it
  double camera_ahead_m = 0.1;  ///< of the vehicle's middle
  double brake_m_s2 = 2.0;      ///< the speed is one that can be braked within what is free
  double stop_m = 0.3;          ///< that much of it is left over
  double lag_s = 0.15;          ///< a vehicle under way flies on for so long ...
  double turn_per_s = 3.0;      ///< ... then its velocity comes nearer to the wanted one at this rate ...
  double turn_m_s2 = 8.0;       ///< ... but changes no faster than this
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const CorridorOptions& options);

struct Corridor {
  double angle_rad = 0.0;    ///< the chosen direction, to the right of the heading
  double free_m = 0.0;       ///< how far it is free
  double bare_m = 0.0;       ///< how far it is as wide as the vehicle
  double goal_free_m = 0.0;  ///< how far the goal's direction is
  double close_m = 0.0;      ///< the nearest thing in the fan
  double speed_m_s = 0.0;    ///< that can still be braked
};

/// The direction that is free for long, with room to spare, and near to the goal's, on a map of what all frames have
/// shown.
class CorridorPlanner {
 public:
  explicit CorridorPlanner(const CorridorOptions& options = {}, const OccupancyOptions& map = {});
  /// scan: of this frame; nothing where it shows nothing. position_m, yaw_rad: of the vehicle against fixed axes
  /// (north, east), yaw to the right. goal_rad: to the right of the heading. velocity_m_s: forward, right.
  Corridor plan(const std::optional<HorizonScan>& scan, const Eigen::Vector2d& position_m, double yaw_rad,
                double goal_rad, const Eigen::Vector2d& velocity_m_s = Eigen::Vector2d::Zero());
  void reset() noexcept;
  [[nodiscard]] const CorridorOptions& options() const noexcept { return options_; }
  /// What stood where when last planned, heading frame.
  [[nodiscard]] const Obstacles& things() const noexcept { return things_; }

 private:
  /// How far two corridors, a narrow one and a wide one, are free on the way that the vehicle takes to a direction.
  struct Free {
    double narrow_m = 0.0;
    double wide_m = 0.0;
    double bare_m = 0.0;
    double crowd = 0.0;  ///< mean over the way's first need_m of the squared share of the wide corridor that is taken;
                         ///< 1 beyond where nothing as wide as the vehicle is free
  };
  [[nodiscard]] Free free_length(double angle_rad, const Eigen::Vector2d& velocity_m_s) const;
  [[nodiscard]] double clearance(const Eigen::Vector2d& point_m) const;
  void measure();

  CorridorOptions options_;
  OccupancyMap map_;
  double cell_m_;
  Obstacles things_;
  cv::Mat clearance_;  ///< CV_32F: of the cells about the vehicle from the nearest thing, metres, heading frame
  std::optional<double> last_rad_;  ///< fixed axes
};

}  // namespace ajna::tasks
