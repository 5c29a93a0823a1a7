// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace ajna::geometry {

/// A rigid transform T_a_b: point_a = rotation * point_b + translation, metres.
struct Pose {
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();

  [[nodiscard]] Pose inverse() const;
  [[nodiscard]] Eigen::Vector3d transform(const Eigen::Vector3d& point) const { return rotation * point + translation; }
};

/// T_a_c = T_a_b * T_b_c.
Pose operator*(const Pose& a, const Pose& b);

/// Rotation of a frame that turns for `dt_s` at the constant `angular_velocity_rad_s` (in its own axes): R_begin_end.
Eigen::Quaterniond rotation_after(const Eigen::Vector3d& angular_velocity_rad_s, double dt_s);

/// A vector of the camera's optical frame (x right, y down, z forward) in the body frame (forward, right, down) of a
/// camera that looks forward.
inline Eigen::Vector3d body_from_camera(const Eigen::Vector3d& v) { return {v.z(), v.x(), v.y()}; }
/// The inverse of body_from_camera.
inline Eigen::Vector3d camera_from_body(const Eigen::Vector3d& v) { return {v.y(), v.z(), v.x()}; }

}  // namespace ajna::geometry
