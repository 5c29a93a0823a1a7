// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <deque>
#include <mutex>
#include <optional>
#include <vector>

#include "ajna/skills/signal.hpp"

namespace ajna::flight {

/// What an ATTITUDE message said, and when it was sent by our clock.
struct AttitudeSample {
  double time_s = 0.0;
  Eigen::Vector3d euler_rad = Eigen::Vector3d::Zero();    ///< roll, pitch, yaw of the body (forward, right, down)
  Eigen::Vector3d rates_rad_s = Eigen::Vector3d::Zero();  ///< body
};

/// The attitudes of the last seconds; written by one thread and read by another.
class AttitudeHistory {
 public:
  void add(const std::vector<AttitudeSample>& samples);
  /// Attitude of a camera that is turned up by camera_pitch_rad from the body's forward axis, at a time: between two
  /// samples by interpolation, up to 0.1 s after the last one by its rates. Nothing for other times, or where the two
  /// samples are more than 0.3 s apart.
  [[nodiscard]] std::optional<skills::Attitude> at(double time_s, double camera_pitch_rad = 0.0) const;

 private:
  mutable std::mutex mutex_;
  std::deque<AttitudeSample> samples_;
};

}  // namespace ajna::flight
