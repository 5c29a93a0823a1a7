// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>

namespace ajna::control {

/// Which numbers of a Command count.
enum class CommandMode {
  kHold,          ///< stay here: the autopilot's position hold; all numbers are 0
  kVelocity,      ///< velocity_m_s and yaw_rate_rad_s
  kAcceleration,  ///< acceleration_m_s2 and yaw_rate_rad_s; velocity_m_s is what the acceleration aims at
};
const char* to_string(CommandMode mode) noexcept;

/// What a policy asks of the autopilot. Vectors are in the levelled body frame: forward, right, down.
struct Command {
  CommandMode mode = CommandMode::kHold;
  Eigen::Vector3d velocity_m_s = Eigen::Vector3d::Zero();
  Eigen::Vector3d acceleration_m_s2 = Eigen::Vector3d::Zero();  ///< gravity excluded: the net thrust vector over mass
  double yaw_rate_rad_s = 0.0;                                  ///< positive: to the right

  static Command hold() { return {}; }
  static Command velocity(const Eigen::Vector3d& velocity_m_s, double yaw_rate_rad_s = 0.0);

  /// Thrust over mass that realises acceleration_m_s2 against gravity (9.80665 m/s^2 down): direction and amount.
  [[nodiscard]] Eigen::Vector3d thrust_m_s2() const;
};

/// `v`, shortened to `max_norm` where it is longer.
Eigen::Vector3d limit_norm(const Eigen::Vector3d& v, double max_norm);

}  // namespace ajna::control
