// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cmath>

#include "ajna/tasks/horizon.hpp"

namespace ajna::tasks {

/// What 140 columns of 80 degrees show of a trunk that stands across the way; nothing else is there.
inline HorizonScan trunk(double forward_m, double right_m, double width_m = 0.6) {
  constexpr int kColumns = 140;
  constexpr double kHalf = 0.7;
  HorizonScan scan;
  for (int i = 0; i < kColumns; ++i) {
    const double angle = kHalf * (2.0 * i / (kColumns - 1) - 1.0);
    const Eigen::Vector2d ray(std::cos(angle), std::sin(angle));
    const double reach = forward_m / ray.x();
    if (forward_m > 0.0 && std::abs(reach * ray.y() - right_m) <= width_m / 2.0) {
      scan.things.emplace_back(reach * ray);
    } else {
      scan.free.emplace_back(HorizonOptions{}.max_distance_m * ray);
    }
  }
  return scan;
}

inline HorizonScan nothing() { return trunk(-1.0, 0.0); }

}  // namespace ajna::tasks
