// SPDX-License-Identifier: MIT
#pragma once

#include <array>
#include <cstdint>

namespace ajna::flight {

/// Histogram of durations in bins of 1 ms up to 1 s; fixed memory, however long the flight. Not thread-safe.
class LatencyHistogram {
 public:
  void add(double seconds) noexcept;
  [[nodiscard]] std::uint64_t count() const noexcept { return count_; }
  /// Upper edge of the bin in which the share `q` of the values is reached, milliseconds; 0 without values.
  [[nodiscard]] double quantile_ms(double q) const noexcept;
  [[nodiscard]] double max_ms() const noexcept { return max_ms_; }
  void merge(const LatencyHistogram& other) noexcept;

 private:
  static constexpr std::size_t kBins = 1001;  // the last one: everything above
  std::array<std::uint64_t, kBins> bins_{};
  std::uint64_t count_ = 0;
  double max_ms_ = 0.0;
};

}  // namespace ajna::flight
