// SPDX-License-Identifier: MIT
#include "ajna/geometry/pose.hpp"

namespace ajna::geometry {

Pose Pose::inverse() const {
  const Eigen::Quaterniond back = rotation.conjugate();
  return {back, -(back * translation)};
}

Pose operator*(const Pose& a, const Pose& b) {
  return {(a.rotation * b.rotation).normalized(), a.rotation * b.translation + a.translation};
}

Eigen::Quaterniond rotation_after(const Eigen::Vector3d& angular_velocity_rad_s, double dt_s) {
  const Eigen::Vector3d turn = angular_velocity_rad_s * dt_s;
  const double angle = turn.norm();
  if (angle < 1e-12) {
    return Eigen::Quaterniond::Identity();
  }
  return Eigen::Quaterniond(Eigen::AngleAxisd(angle, turn / angle));
}

}  // namespace ajna::geometry
