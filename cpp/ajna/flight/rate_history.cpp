// SPDX-License-Identifier: MIT
#include "ajna/flight/rate_history.hpp"

namespace ajna::flight {

void RateHistory::add(const std::vector<RateSample>& samples) {
  constexpr std::size_t kKept = 512;
  const std::lock_guard lock(mutex_);
  samples_.insert(samples_.end(), samples.begin(), samples.end());
  while (samples_.size() > kKept) {
    samples_.pop_front();
  }
}

std::optional<Eigen::Vector3d> RateHistory::mean(double from_s, double to_s) const {
  constexpr double kBefore_s = 0.1;
  const std::lock_guard lock(mutex_);
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  int count = 0;
  std::optional<Eigen::Vector3d> before;
  for (const auto& sample : samples_) {
    if (sample.time_s >= from_s && sample.time_s <= to_s) {
      sum += sample.rates_rad_s;
      ++count;
    } else if (sample.time_s < from_s && from_s - sample.time_s <= kBefore_s) {
      before = sample.rates_rad_s;
    }
  }
  return count > 0 ? std::optional<Eigen::Vector3d>(sum / count) : before;
}

Eigen::Vector3d optical_from_body(const Eigen::Vector3d& body) { return {body.y(), body.z(), body.x()}; }

}  // namespace ajna::flight
