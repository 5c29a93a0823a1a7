// SPDX-License-Identifier: MIT
#include "ajna/control/command.hpp"

namespace ajna::control {

constexpr double kGravity = 9.80665;  // m / s^2

const char* to_string(CommandMode mode) noexcept {
  switch (mode) {
    case CommandMode::kHold:
      return "hold";
    case CommandMode::kVelocity:
      return "velocity";
    case CommandMode::kAcceleration:
      return "acceleration";
  }
  return "unknown";
}

Command Command::velocity(const Eigen::Vector3d& velocity_m_s, double yaw_rate_rad_s) {
  Command command;
  command.mode = CommandMode::kVelocity;
  command.velocity_m_s = velocity_m_s;
  command.yaw_rate_rad_s = yaw_rate_rad_s;
  return command;
}

Eigen::Vector3d Command::thrust_m_s2() const { return acceleration_m_s2 - Eigen::Vector3d(0.0, 0.0, kGravity); }

Eigen::Vector3d limit_norm(const Eigen::Vector3d& v, double max_norm) {
  const double norm = v.norm();
  return norm > max_norm ? Eigen::Vector3d(v * (max_norm / norm)) : v;
}

}  // namespace ajna::control
