// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <vector>

#include "ajna/base/flow_field.hpp"
#include "ajna/geometry/camera.hpp"

namespace ajna::geometry {

/// Velocity of a camera in its own optical frame.
struct CameraMotion {
  Eigen::Vector3d velocity_m_s = Eigen::Vector3d::Zero();            ///< V of Eq. 14
  Eigen::Vector3d angular_velocity_rad_s = Eigen::Vector3d::Zero();  ///< Omega of Eq. 14
};

/// The part of Eq. 14 that depends on depth: image velocity of the static point at `normalized`, in normalised
/// coordinates per second. inverse_depth = 1 / Z, 1 / m; 0 is infinitely far.
Eigen::Vector2d translational_flow(const Eigen::Vector2d& normalized, double inverse_depth,
                                   const Eigen::Vector3d& velocity_m_s);
/// The part of Eq. 14 that does not.
Eigen::Vector2d rotational_flow(const Eigen::Vector2d& normalized, const Eigen::Vector3d& angular_velocity_rad_s);
/// Both together: Eq. 14.
Eigen::Vector2d motion_field(const Eigen::Vector2d& normalized, double inverse_depth, const CameraMotion& motion);

/// Eq. 14 over a whole image: flow in pixels over dt_s, height x width x 2 as in FlowField.
/// inverse_depth: height x width, 1 / m. First order in dt_s.
/// Throws Error(kInvalidArgument) where its size is not the camera's.
std::vector<float> motion_field(const Camera& camera, const std::vector<float>& inverse_depth,
                                const CameraMotion& motion, double dt_s);

/// Where a point seen at `pixel` at the beginning of an interval is seen at its end if the camera only turns, exactly
/// (not to first order); off the image or behind the camera it is still the point's line of sight that counts, and a
/// point that ends behind the camera keeps its pixel.
Eigen::Vector2d rotate_pixel(const Camera& camera, const Eigen::Vector2d& pixel,
                             const Eigen::Vector3d& angular_velocity_rad_s, double dt_s);
/// The measured end point of a motion as it would be had the camera not turned: the inverse of rotate_pixel.
Eigen::Vector2d derotate_pixel(const Camera& camera, const Eigen::Vector2d& pixel,
                               const Eigen::Vector3d& angular_velocity_rad_s, double dt_s);
/// Remove the camera's turn from a measured flow, in place: what remains is inversely proportional to depth.
/// angular_velocity_rad_s in the optical frame, as a gyro rate gives it. Throws where sizes differ.
void derotate_flow(const Camera& camera, const Eigen::Vector3d& angular_velocity_rad_s, double dt_s, FlowField& field);

}  // namespace ajna::geometry
