// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>

#include "ajna/tasks/cost_to_go.hpp"
#include "ajna/tasks/horizon.hpp"
#include "ajna/tasks/occupancy.hpp"

namespace ajna::tasks {

struct CorridorOptions {
  double half_width_m = 0.45;  ///< of the corridor that must be free: vehicle, and room on both sides
  double bare_m = 0.3;         ///< half the vehicle's own width: where there is no more, it flies slowly ...
  double squeeze_m_s = 1.0;    ///< ... at no more than this
  double room_m = 0.3;         ///< more of it on both sides is better
  double crowd_weight = 8.0;  ///< a metre of way costs up to so much more where things stand nearer to it than that ...
  double blocked_weight = 20.0;  ///< ... and so much where the vehicle would touch them
  double goal_ahead_m = 15.0;    ///< the goal is taken to be so far away: what lies behind the map is taken for free
  double side_m = 6.0;           ///< ways lead at most so far to a side
  double fan_rad = 0.7;          ///< directions are looked at up to so far to both sides
  int directions = 81;           ///< in that fan
  double blocked_m = 1.0;        ///< where the way is free for no more, and the vehicle hardly moves ...
  double wide_fan_rad = 1.6;     ///< ... they are looked at up to so far
  double horizon_m = 9.0;        ///< free further than this is no better
  int support = 2;               ///< so many cells of the map must stand side by side to count
  double keep_weight = 0.3;  ///< metres of way, per radian to the last choice: what is turned back from halfway is hit
  double least_way_m = 0.5;  ///< a direction is kept for at least so far ...
  double least_way_s = 0.4;  ///< ... and so long ...
  double need_m = 3.5;       ///< ... and at most so far, where that is longer
  double aside_rad = 0.3;    ///< directions further aside than this are flown without speeding up
  double camera_ahead_m = 0.1;  ///< of the vehicle's middle
  double brake_m_s2 = 3.0;      ///< the speed is one that can be braked within what is free
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

/// Where a vehicle will be when a command of now acts, and how it will fly then: heading frame of now (forward,
/// right), metres from where it is.
struct CorridorStart {
  Eigen::Vector2d velocity_m_s = Eigen::Vector2d::Zero();
  Eigen::Vector2d moved_m = Eigen::Vector2d::Zero();
};

/// The way to the goal that costs least on a map of what all frames have shown: a metre costs 1, more where things
/// stand near to it, much more where the vehicle touches them. What a way costs from each point on is solved for first
/// (CostToGo). The vehicle cannot turn on the spot: each direction is flown, as far as it is known how it turns, for at
/// least its next half second, and the one is chosen that costs least, up to where it is best left and from there on.
class CorridorPlanner {
 public:
  explicit CorridorPlanner(const CorridorOptions& options = {}, const OccupancyOptions& map = {});
  /// scan: of this frame; nothing where it shows nothing. position_m, yaw_rad: of the vehicle against fixed axes
  /// (north, east), yaw to the right. goal_rad: to the right of the heading. start: of the way that is chosen.
  Corridor plan(const std::optional<HorizonScan>& scan, const Eigen::Vector2d& position_m, double yaw_rad,
                double goal_rad, const CorridorStart& start = {});
  void reset() noexcept;
  [[nodiscard]] const CorridorOptions& options() const noexcept { return options_; }
  /// What stood where when last planned, heading frame.
  [[nodiscard]] const Obstacles& things() const noexcept { return things_; }

 private:
  struct Way {
    double cost = 0.0;      ///< up to best_m, and from there on
    double best_m = 0.0;    ///< where the direction is best left
    double narrow_m = 0.0;  ///< how far a corridor of half_width_m is free
    double bare_m = 0.0;    ///< how far one of bare_m is
  };
  /// The way that the vehicle takes to a direction, kept for hold_m, then the cheapest way on, up to end_m.
  [[nodiscard]] Way roll(double angle_rad, double hold_m, double end_m, const CorridorStart& start) const;
  [[nodiscard]] double least_way_m(const CorridorStart& start) const;
  void solve(double goal_rad);
  [[nodiscard]] double cost(double clearance_m) const;
  [[nodiscard]] double speed_for(const Corridor& corridor, const CorridorStart& start) const;
  [[nodiscard]] double clearance(const Eigen::Vector2d& point_m) const;
  [[nodiscard]] Eigen::Vector2d middle_m(const CorridorStart& start) const;  ///< of the vehicle, from its camera
  void measure();

  CorridorOptions options_;
  OccupancyMap map_;
  double cell_m_;
  CostToGo to_go_;
  Obstacles things_;
  cv::Mat clearance_;  ///< CV_32F: of the cells about the vehicle from the nearest thing, metres, heading frame
  std::optional<double> last_rad_;  ///< fixed axes
};

}  // namespace ajna::tasks
