// SPDX-License-Identifier: MIT
#pragma once

#include <cmath>
#include <optional>

namespace ajna::tasks {

/// How a frame's time stamp stands to the last one's.
enum class FrameOrder {
  kFirst,       ///< nothing before it
  kNext,        ///< in order
  kAfterGap,    ///< in order, but frames are missing: what was tracked is too old
  kOutOfOrder,  ///< not later than the last, or not a number: to be ignored
};

/// Judges time stamps; shared by the pipelines that remember.
class FrameClock {
 public:
  explicit FrameClock(double max_gap_s) : max_gap_s_(max_gap_s) {}
  FrameOrder next(double time_s) noexcept {
    if (!std::isfinite(time_s) || (last_s_ && time_s <= *last_s_)) {
      return FrameOrder::kOutOfOrder;
    }
    const FrameOrder order = !last_s_                         ? FrameOrder::kFirst
                             : time_s - *last_s_ > max_gap_s_ ? FrameOrder::kAfterGap
                                                              : FrameOrder::kNext;
    interval_s_ = last_s_ ? time_s - *last_s_ : 0.0;
    last_s_ = time_s;
    return order;
  }
  /// From the frame before the last one in order to that one; 0 where there is none.
  [[nodiscard]] double interval_s() const noexcept { return interval_s_; }
  void reset() noexcept {
    last_s_.reset();
    interval_s_ = 0.0;
  }

 private:
  double max_gap_s_;
  double interval_s_ = 0.0;
  std::optional<double> last_s_;
};

}  // namespace ajna::tasks
