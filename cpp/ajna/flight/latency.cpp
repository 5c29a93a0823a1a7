// SPDX-License-Identifier: MIT
#include "ajna/flight/latency.hpp"

#include <algorithm>
#include <cmath>

namespace ajna::flight {

void LatencyHistogram::add(double seconds) noexcept {
  if (!std::isfinite(seconds)) {
    return;
  }
  const double ms = std::max(seconds, 0.0) * 1e3;
  ++bins_[static_cast<std::size_t>(std::min(ms, static_cast<double>(kBins - 1)))];
  ++count_;
  max_ms_ = std::max(max_ms_, ms);
}

double LatencyHistogram::quantile_ms(double q) const noexcept {
  if (count_ == 0) {
    return 0.0;
  }
  const auto rank = static_cast<std::uint64_t>(std::ceil(std::clamp(q, 0.0, 1.0) * static_cast<double>(count_)));
  std::uint64_t seen = 0;
  for (std::size_t i = 0; i < kBins; ++i) {
    seen += bins_[i];
    if (seen >= std::max<std::uint64_t>(rank, 1)) {
      return i + 1 < kBins ? static_cast<double>(i + 1) : max_ms_;
    }
  }
  return max_ms_;
}

void LatencyHistogram::merge(const LatencyHistogram& other) noexcept {
  for (std::size_t i = 0; i < kBins; ++i) {
    bins_[i] += other.bins_[i];
  }
  count_ += other.count_;
  max_ms_ = std::max(max_ms_, other.max_ms_);
}

}  // namespace ajna::flight
