// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <deque>
#include <opencv2/core.hpp>
#include <optional>
#include <vector>

namespace ajna::tasks {

/// From uncertainty along the horizon to where things stand, seen from above. For a vehicle that holds its height, what
/// it can hit lies at the height of its camera: on the horizon of its image, however it is tilted.
struct HorizonOptions {
  double band = 0.1;             ///< half height of the band about the horizon, as a slope (tangent)
  double floor = 0.272;          ///< uncertainty without motion, units of the map
  double per_px = 0.0312;        ///< uncertainty per pixel of motion
  double least_shift_px = 4.8;  ///< a pixel's uncertainty is that of one at least so far from the focus of expansion:
                                 ///< a network sees a thing's motion, not a pixel's
  double max_distance_m = 9.0;   ///< further is free
  double min_move_m = 0.12;      ///< between the frames: less shows nothing
  int column_step = 2;           ///< pixels
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const HorizonOptions& options);

/// A thing at the camera's height: forward and right of it in the levelled heading frame, metres.
using Obstacles = std::vector<Eigen::Vector2d>;

/// The nearest thing of each column of the map. A point at depth Z that is r pixels from the focus of expansion moves
/// by r b / Z pixels while the camera moves by b; so with uncertainty Y = floor + per_px (r + least_shift_px) b / Z,
/// the depth is per_px (r + least_shift_px) b / (Y - floor).
///
/// map: CV_32F, of a pair from which turning is taken out. valid: CV_8U, 0 where the map says nothing; empty: nowhere.
/// heading_from_camera: rotation, see skills::Attitude. move_m: the camera's motion between the frames, heading frame.
/// Nothing where it is shorter than min_move_m, or backwards, or where less than half of the columns see the horizon.
/// Throws Error(kInvalidArgument) for a map or a mask that is none.
std::optional<Obstacles> horizon_obstacles(const cv::Mat& map, const cv::Mat& valid,
                                           const Eigen::Matrix3d& heading_from_camera, double horizontal_fov_rad,
                                           const Eigen::Vector3d& move_m, const HorizonOptions& options = {});

struct CorridorOptions {
  double half_width_m = 0.45;    ///< of the corridor that must be free: vehicle, and room on both sides
  double room_m = 0.3;           ///< more of it on both sides is better
  double fan_rad = 0.7;          ///< directions are looked at up to so far to both sides
  int directions = 81;           ///< in that fan
  double horizon_m = 9.0;        ///< free further than this is no better
  double remember_m = 4.0;       ///< nearer things count on after they have left the picture ...
  double remember_s = 3.0;       ///< ... for so long at most ...
  double remember_move_m = 3.0;  ///< ... and until the vehicle has moved so far
  double stay_m = 0.5;           ///< a vehicle that has moved less forgets nothing: at rest it sees nothing new
  int support = 3;               ///< so many points must stand in a corridor to block it
  double room_weight = 0.35;     ///< of the wider corridor's length against the narrow one's, both over horizon_m
  double goal_weight = 0.4;      ///< of the angle to the goal, per radian
  double keep_weight = 0.3;  ///< of the angle to the last choice, per radian: what is turned back from halfway is hit
  double need_m = 3.5;       ///< what is free for less ...
  double need_weight = 1.5;  ///< ... loses by so much times the missing share
  double brake_m_s2 = 4.0;   ///< the speed is one that can be braked within what is free
  double stop_m = 0.3;       ///< that much of it is left over
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const CorridorOptions& options);

struct Corridor {
  double angle_rad = 0.0;    ///< the chosen direction, to the right of the heading
  double free_m = 0.0;       ///< how far it is free
  double goal_free_m = 0.0;  ///< how far the goal's direction is
  double close_m = 0.0;      ///< the nearest thing in the fan
  double speed_m_s = 0.0;    ///< that can still be braked
};

/// The direction that is free for long, with room to spare, and near to the goal's. Things seen in the last moments
/// still count when they have left the picture.
class CorridorPlanner {
 public:
  explicit CorridorPlanner(const CorridorOptions& options = {});
  /// obstacles: of this frame. position_m, yaw_rad: of the vehicle against fixed axes (north, east), yaw to the right.
  /// goal_rad: to the right of the heading.
  Corridor plan(const Obstacles& obstacles, double time_s, const Eigen::Vector2d& position_m, double yaw_rad,
                double goal_rad);
  void reset() noexcept;
  [[nodiscard]] const CorridorOptions& options() const noexcept { return options_; }

 private:
  struct Seen {
    double time_s;
    Eigen::Vector2d from_m;
    Obstacles at_m;  ///< fixed axes
  };
  [[nodiscard]] double free_length(const Obstacles& obstacles, double angle_rad, double half_width_m) const;

  CorridorOptions options_;
  std::deque<Seen> memory_;
  std::optional<double> last_rad_;  ///< fixed axes
};

}  // namespace ajna::tasks
