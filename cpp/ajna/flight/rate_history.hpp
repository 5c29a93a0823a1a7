// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <deque>
#include <mutex>
#include <optional>
#include <vector>

namespace ajna::flight {

/// Angular velocity of the body (forward, right, down) when it arrived.
struct RateSample {
  double time_s = 0.0;
  Eigen::Vector3d rates_rad_s = Eigen::Vector3d::Zero();
};

/// The gyro rates of the last seconds; written by one thread and read by another.
class RateHistory {
 public:
  void add(const std::vector<RateSample>& samples);
  /// Mean over an interval of arrival times; the last sample before it where none lies in it; nothing where that one is
  /// more than 0.1 s old.
  [[nodiscard]] std::optional<Eigen::Vector3d> mean(double from_s, double to_s) const;

 private:
  mutable std::mutex mutex_;
  std::deque<RateSample> samples_;
};

/// The same rotation in the optical frame (right, down, forward) of a camera that looks along the body's forward axis.
Eigen::Vector3d optical_from_body(const Eigen::Vector3d& body);

}  // namespace ajna::flight
