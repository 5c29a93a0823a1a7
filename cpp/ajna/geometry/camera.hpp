// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <optional>

namespace ajna::geometry {

/// A pinhole camera without distortion. Pixel (0, 0) is the centre of the top left pixel; the optical frame is x right,
/// y down, z forward. Normalised coordinates are (X / Z, Y / Z).
struct Camera {
  int width = 0;    ///< pixels
  int height = 0;   ///< pixels
  double fx = 0.0;  ///< focal length along x, pixels
  double fy = 0.0;  ///< focal length along y, pixels
  double cx = 0.0;  ///< principal point, pixels
  double cy = 0.0;  ///< principal point, pixels

  /// Square pixels, principal point in the middle, `fov_rad` from the left to the right edge of the image.
  /// Throws Error(kInvalidArgument) for sides below 1 and angles outside (0, pi).
  static Camera from_horizontal_fov(int width, int height, double fov_rad);

  [[nodiscard]] Eigen::Vector2d normalize(const Eigen::Vector2d& pixel) const;
  [[nodiscard]] Eigen::Vector2d to_pixel(const Eigen::Vector2d& normalized) const;
  /// Unit vector in the optical frame through `pixel`.
  [[nodiscard]] Eigen::Vector3d ray(const Eigen::Vector2d& pixel) const;
  /// Pixel of a point or direction in the optical frame; nothing where it lies behind the camera or in its plane.
  [[nodiscard]] std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& point) const;
  [[nodiscard]] bool contains(const Eigen::Vector2d& pixel) const;
  /// The same camera after its image was resized.
  [[nodiscard]] Camera resized(int new_width, int new_height) const;
};

/// Throws Error(kInvalidArgument) that names the first field out of range.
void validate(const Camera& camera);

}  // namespace ajna::geometry
