// SPDX-License-Identifier: MIT
#include "ajna/geometry/camera.hpp"

#include <Eigen/Geometry>
#include <cmath>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna::geometry {
namespace {

constexpr double kMinDepth = 1e-9;

void check_size(int width, int height) {
  if (width < 1 || height < 1) {
    throw_invalid("camera image is " + std::to_string(width) + "x" + std::to_string(height) +
                  ": give sides of at least 1 pixel");
  }
}

}  // namespace

Camera Camera::from_horizontal_fov(int width, int height, double fov_rad) {
  check_size(width, height);
  if (!(fov_rad > 0.0 && fov_rad < M_PI)) {
    throw_invalid("horizontal field of view " + std::to_string(fov_rad) + " rad: give an angle between 0 and pi");
  }
  Camera camera;
  camera.width = width;
  camera.height = height;
  camera.fx = camera.fy = 0.5 * width / std::tan(0.5 * fov_rad);
  camera.cx = 0.5 * (width - 1);
  camera.cy = 0.5 * (height - 1);
  return camera;
}

Eigen::Vector2d Camera::normalize(const Eigen::Vector2d& pixel) const {
  return {(pixel.x() - cx) / fx, (pixel.y() - cy) / fy};
}

Eigen::Vector2d Camera::to_pixel(const Eigen::Vector2d& normalized) const {
  return {fx * normalized.x() + cx, fy * normalized.y() + cy};
}

Eigen::Vector3d Camera::ray(const Eigen::Vector2d& pixel) const { return normalize(pixel).homogeneous().normalized(); }

std::optional<Eigen::Vector2d> Camera::project(const Eigen::Vector3d& point) const {
  if (!(point.z() > kMinDepth)) {
    return std::nullopt;
  }
  return to_pixel(point.head<2>() / point.z());
}

bool Camera::contains(const Eigen::Vector2d& pixel) const {
  return pixel.x() >= -0.5 && pixel.y() >= -0.5 && pixel.x() < width - 0.5 && pixel.y() < height - 0.5;
}

Camera Camera::resized(int new_width, int new_height) const {
  check_size(new_width, new_height);
  const double sx = static_cast<double>(new_width) / width;
  const double sy = static_cast<double>(new_height) / height;
  // Pixel centres are integers: the edge of the image, at -0.5, is what stays in place.
  return {new_width, new_height, fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5};
}

void validate(const Camera& camera) {
  check_size(camera.width, camera.height);
  if (!(std::isfinite(camera.fx) && std::isfinite(camera.fy) && camera.fx > 0.0 && camera.fy > 0.0)) {
    throw_invalid("camera focal lengths are " + std::to_string(camera.fx) + " and " + std::to_string(camera.fy) +
                  ": give positive pixels");
  }
  if (!(std::isfinite(camera.cx) && std::isfinite(camera.cy))) {
    throw_invalid("camera principal point is not finite: give pixels");
  }
}

}  // namespace ajna::geometry
