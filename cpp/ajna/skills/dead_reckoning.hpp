// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <deque>
#include <optional>

namespace ajna::skills {

/// Where the camera is since the beginning, from measured velocities: good for the moments that a pair of frames spans
/// and for things that are remembered for a few metres, not for a map.
///
/// Axes do not turn with the vehicle: north, east, down; yaw is to the right. The camera sits ahead of the vehicle's
/// middle, so that it moves sideways where the vehicle turns on the spot.
class DeadReckoning {
 public:
  /// ahead_m: of the camera, before the middle. keep_s: for how long it is remembered where the camera was.
  DeadReckoning(double ahead_m, double keep_s) : ahead_m_(ahead_m), keep_s_(keep_s) {}
  void reset() noexcept;
  /// A measurement: velocity of the vehicle's middle in the levelled heading frame (forward, right, down). Between two
  /// the velocity changes evenly. A time that is not later than the last is ignored; over more than half a second
  /// nothing is known of the way.
  void move(double time_s, double yaw_rad, const Eigen::Vector3d& velocity_m_s);
  /// A frame without a measurement: the way from the last one to the next is not known.
  void lose() noexcept { last_.reset(); }
  /// Of the camera since the beginning: north, east, down. A way that is not known is left out.
  [[nodiscard]] const Eigen::Vector3d& position_m() const noexcept { return position_m_; }
  /// How far the camera has come since then, metres (forward, right, down) in the heading frame of the last
  /// measurement; nothing where not all of the way is known.
  [[nodiscard]] std::optional<Eigen::Vector3d> moved_since(double time_s) const;

 private:
  struct Point {
    double time_s;
    Eigen::Vector3d at_m;
  };
  struct Last {
    double time_s;
    double yaw_rad;
    Eigen::Vector3d velocity_m_s;  ///< fixed axes
  };
  double ahead_m_;
  double keep_s_;
  Eigen::Vector3d middle_m_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d position_m_ = Eigen::Vector3d::Zero();
  std::optional<Last> last_;
  std::deque<Point> way_;  ///< without gaps
};

}  // namespace ajna::skills
