// SPDX-License-Identifier: MIT
#include "ajna/flight/sender_clock.hpp"

#include <algorithm>

namespace ajna::flight {
namespace {

/// Clocks of crystals drift apart by less; the smallest offset is let go of at this rate.
constexpr double kDrift = 2e-4;
/// A message that seems to be older than this was not delayed: a clock has jumped.
constexpr double kJump_s = 0.5;

}  // namespace

double SenderClock::sent_s(std::uint32_t stamp_ms, double arrival_s) noexcept {
  const double offset_s = arrival_s - 1e-3 * stamp_ms;
  const bool forward = stamp_ms > stamp_ms_ && arrival_s >= arrival_s_;
  const double since_s = arrival_s - arrival_s_;
  stamp_ms_ = stamp_ms;
  arrival_s_ = arrival_s;
  if (!forward) {
    offset_s_.reset();
    return arrival_s;
  }
  if (offset_s_) {
    *offset_s_ += kDrift * since_s;
  }
  if (!offset_s_ || offset_s - *offset_s_ > kJump_s || *offset_s_ - offset_s > kJump_s) {
    offset_s_ = offset_s;
    return arrival_s;
  }
  offset_s_ = std::min(*offset_s_, offset_s);
  return std::min(1e-3 * stamp_ms + *offset_s_, arrival_s);
}

}  // namespace ajna::flight
