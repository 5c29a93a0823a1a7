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
    last_s_ = time_s;
    return order;
  }
  void reset() noexcept { last_s_.reset(); }

 private:
  double max_gap_s_;
  std::optional<double> last_s_;
};

}  // namespace ajna::tasks
