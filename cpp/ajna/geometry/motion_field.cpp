// SPDX-License-Identifier: MIT
#include "ajna/geometry/motion_field.hpp"

#include <Eigen/Geometry>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/geometry/pose.hpp"

namespace ajna::geometry {
namespace {

std::size_t pixel_count(const Camera& camera) {
  return static_cast<std::size_t>(camera.width) * static_cast<std::size_t>(camera.height);
}

Eigen::Vector2d turned(const Camera& camera, const Eigen::Vector2d& pixel, const Eigen::Matrix3d& rotation) {
  const Eigen::Vector3d ray = rotation * camera.normalize(pixel).homogeneous();
  return camera.project(ray).value_or(pixel);
}

}  // namespace

Eigen::Vector2d translational_flow(const Eigen::Vector2d& normalized, double inverse_depth,
                                   const Eigen::Vector3d& velocity_m_s) {
  return inverse_depth * (normalized * velocity_m_s.z() - velocity_m_s.head<2>());
}

Eigen::Vector2d rotational_flow(const Eigen::Vector2d& normalized, const Eigen::Vector3d& angular_velocity_rad_s) {
  const double x = normalized.x();
  const double y = normalized.y();
  Eigen::Matrix<double, 2, 3> a;
  a << x * y, -(1.0 + x * x), y, 1.0 + y * y, -x * y, -x;
  return a * angular_velocity_rad_s;
}

Eigen::Vector2d motion_field(const Eigen::Vector2d& normalized, double inverse_depth, const CameraMotion& motion) {
  return translational_flow(normalized, inverse_depth, motion.velocity_m_s) +
         rotational_flow(normalized, motion.angular_velocity_rad_s);
}

std::vector<float> motion_field(const Camera& camera, const std::vector<float>& inverse_depth,
                                const CameraMotion& motion, double dt_s) {
  validate(camera);
  if (inverse_depth.size() != pixel_count(camera)) {
    throw_invalid("inverse depth has " + std::to_string(inverse_depth.size()) + " values: give one per pixel of the " +
                  std::to_string(camera.width) + "x" + std::to_string(camera.height) + " camera");
  }
  std::vector<float> flow(2 * inverse_depth.size());
  std::size_t i = 0;
  for (int v = 0; v < camera.height; ++v) {
    for (int u = 0; u < camera.width; ++u, ++i) {
      const Eigen::Vector2d p = motion_field(camera.normalize({u, v}), static_cast<double>(inverse_depth[i]), motion);
      flow[2 * i] = static_cast<float>(p.x() * camera.fx * dt_s);
      flow[2 * i + 1] = static_cast<float>(p.y() * camera.fy * dt_s);
    }
  }
  return flow;
}

Eigen::Vector2d rotate_pixel(const Camera& camera, const Eigen::Vector2d& pixel,
                             const Eigen::Vector3d& angular_velocity_rad_s, double dt_s) {
  // R_begin_end takes end coordinates to begin coordinates; the static point needs the other direction.
  return turned(camera, pixel, rotation_after(angular_velocity_rad_s, dt_s).conjugate().toRotationMatrix());
}

Eigen::Vector2d derotate_pixel(const Camera& camera, const Eigen::Vector2d& pixel,
                               const Eigen::Vector3d& angular_velocity_rad_s, double dt_s) {
  return turned(camera, pixel, rotation_after(angular_velocity_rad_s, dt_s).toRotationMatrix());
}

void derotate_flow(const Camera& camera, const Eigen::Vector3d& angular_velocity_rad_s, double dt_s, FlowField& field) {
  validate(camera);
  if (field.width != camera.width || field.height != camera.height || field.flow.size() != 2 * pixel_count(camera)) {
    throw_invalid("flow is " + std::to_string(field.width) + "x" + std::to_string(field.height) + " but the camera " +
                  std::to_string(camera.width) + "x" + std::to_string(camera.height) + ": resize the camera");
  }
  const Eigen::Matrix3d rotation = rotation_after(angular_velocity_rad_s, dt_s).toRotationMatrix();
  for (int v = 0; v < camera.height; ++v) {
    for (int u = 0; u < camera.width; ++u) {
      const std::size_t i = field.index(u, v);
      const Eigen::Vector2d begin(u, v);
      const Eigen::Vector2d end = begin + Eigen::Vector2d(field.flow[i], field.flow[i + 1]);
      const Eigen::Vector2d flow = turned(camera, end, rotation) - begin;
      field.flow[i] = static_cast<float>(flow.x());
      field.flow[i + 1] = static_cast<float>(flow.y());
    }
  }
}

}  // namespace ajna::geometry
