// SPDX-License-Identifier: MIT
#include "ajna/tasks/horizon.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/base/range.hpp"
#include "ajna/geometry/camera.hpp"

namespace ajna::tasks {
namespace {

/// The image of an upright line through the horizon: what stands upright lies along it, however the camera is tilted.
struct Upright {
  Eigen::Vector2d along;  ///< level direction to it, heading frame; as long as the ray is at unit depth
  Eigen::Vector2d top;    ///< pixels
  Eigen::Vector2d bottom;
};

std::optional<Upright> upright_of(const geometry::Camera& camera, const Eigen::Matrix3d& rotation, double x,
                                  double slope) {
  const double u = (x - camera.cx) / camera.fx;
  // The ray through row v leads down by r20 u + r21 v + r22 (in units of depth): 0 on the horizon.
  const double per_v = rotation(2, 1);
  if (std::abs(per_v) < 0.2) {
    return std::nullopt;  // the camera lies on its side
  }
  const double v = -(rotation(2, 0) * u + rotation(2, 2)) / per_v;
  const Eigen::Vector3d ray = rotation * Eigen::Vector3d(u, v, 1.0);
  const Eigen::Vector3d rise(0.0, 0.0, slope * ray.head<2>().norm());
  const auto top = camera.project(rotation.transpose() * (ray - rise));
  const auto bottom = camera.project(rotation.transpose() * (ray + rise));
  return top && bottom ? std::optional(Upright{ray.head<2>(), *top, *bottom}) : std::nullopt;
}

}  // namespace

void validate(const HorizonOptions& options) {
  require_between("navigate options: horizon.band", options.band, 0.01, 1.0);
  require_between("navigate options: horizon.floor", options.floor, 0.0, 100.0);
  require_between("navigate options: horizon.per_px", options.per_px, 1e-4, 100.0);
  require_between("navigate options: horizon.least_shift_px", options.least_shift_px, 0.0, 1000.0);
  require_between("navigate options: horizon.saturated", options.saturated, options.floor, 1e6);
  require_between("navigate options: horizon.max_distance_m", options.max_distance_m, 1.0, 1000.0);
  require_between("navigate options: horizon.range_moves", options.range_moves, 1.0, 1e6);
  require_between("navigate options: horizon.min_move_m", options.min_move_m, 1e-3, 10.0);
  require_between("navigate options: horizon.column_step", options.column_step, 1, 64);
}

Obstacles HorizonScan::all_things() const {
  Obstacles all = things;
  all.insert(all.end(), near.begin(), near.end());
  return all;
}

std::optional<HorizonScan> horizon_scan(const cv::Mat& map, const cv::Mat& valid,
                                        const Eigen::Matrix3d& heading_from_camera, double horizontal_fov_rad,
                                        const Eigen::Vector3d& move_m, const HorizonOptions& options) {
  validate(options);
  if (map.empty() || map.type() != CV_32F) {
    throw_invalid("horizon: give a scalar map of uncertainty, float32 [H, W]");
  }
  if (!valid.empty() && (valid.type() != CV_8U || valid.size() != map.size())) {
    throw_invalid("horizon: give a mask of valid pixels of the map's size, uint8 [H, W]");
  }
  const double move = move_m.norm();
  const auto camera = geometry::Camera::from_horizontal_fov(map.cols, map.rows, horizontal_fov_rad);
  const auto focus = move >= options.min_move_m ? camera.project(heading_from_camera.transpose() * move_m)
                                                : std::optional<Eigen::Vector2d>();
  if (!focus) {
    return std::nullopt;
  }
  const double range = std::min(options.max_distance_m, options.range_moves * move);
  HorizonScan scan;
  int columns = 0;
  int seen = 0;
  for (int x = 0; x < map.cols; x += options.column_step) {
    ++columns;
    const auto upright = upright_of(camera, heading_from_camera, x, options.band);
    if (!upright) {
      continue;
    }
    const Eigen::Vector2d span = upright->bottom - upright->top;
    if (!(span.norm() < 2.0 * (map.rows + map.cols))) {
      continue;  // more than half of it lies outside of the image; near the camera's plane lines grow without bound
    }
    const int wanted = static_cast<int>(span.norm()) + 1;
    double sum = 0.0;
    double shift = 0.0;
    int count = 0;
    for (int i = 0; i < wanted; ++i) {
      const Eigen::Vector2d pixel = upright->top + (i + 0.5) / wanted * span;
      const int column = cvRound(pixel.x());
      const int row = cvRound(pixel.y());
      if (row < 0 || row >= map.rows || column < 0 || column >= map.cols ||
          (!valid.empty() && valid.at<std::uint8_t>(row, column) == 0)) {
        continue;
      }
      sum += static_cast<double>(map.at<float>(row, column));
      shift += (pixel - *focus).norm();
      ++count;
    }
    if (count == 0 || 2 * count < wanted) {
      continue;
    }
    ++seen;
    const double excess = sum / count - options.floor;
    const double depth = excess > 0.0 ? options.per_px * (shift / count + options.least_shift_px) * move / excess
                                      : std::numeric_limits<double>::infinity();
    const Eigen::Vector2d& along = upright->along;
    if (depth * along.norm() <= range) {
      (excess + options.floor >= options.saturated ? scan.near : scan.things).emplace_back(depth * along);
    } else {
      scan.free.emplace_back(range * along.normalized());
    }
  }
  return 2 * seen >= columns ? std::optional(scan) : std::nullopt;
}

}  // namespace ajna::tasks
