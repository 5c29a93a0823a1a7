// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <optional>

namespace ajna::flight {

/// When messages were sent, by our clock, from the sender's stamps: the offset between the two clocks is that of the
/// messages that were under way for the shortest time. What the link and our own loop add to single messages, up to
/// tens of milliseconds, is thereby taken out; the shortest delay itself remains. Not thread-safe.
class SenderClock {
 public:
  /// Time of sending, never later than `arrival_s`. The arrival itself where the stamps do not go forward (a sender
  /// without a clock), and after a jump of either clock until the next message.
  double sent_s(std::uint32_t stamp_ms, double arrival_s) noexcept;

 private:
  std::optional<double> offset_s_;  ///< arrival less stamp, the smallest of late
  std::uint32_t stamp_ms_ = 0;
  double arrival_s_ = 0.0;
};

}  // namespace ajna::flight
