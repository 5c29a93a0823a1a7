// SPDX-License-Identifier: MIT
#pragma once

#include <array>
#include <cstdint>

// What an RC_CHANNELS_OVERRIDE message says of each channel. The numbers that mean "release" and "ignore" differ
// between channels 1 to 8 and the extension channels 9 to 18, and 0 means the opposite things in both: only to_wire
// knows them.

namespace ajna::flight {

constexpr int kRcChannels = 18;               ///< of the MAVLink message
constexpr std::uint16_t kMinPulse_us = 1000;  ///< no configuration can make a command go below ...
constexpr std::uint16_t kMaxPulse_us = 2000;  ///< ... or above

/// One channel of a command to the autopilot.
struct ChannelCommand {
  enum class Kind : std::uint8_t {
    kIgnore,   ///< say nothing of this channel: an override of somebody else's stands
    kRelease,  ///< give the channel back to the pilot
    kPulse,    ///< override it with pulse_us
  };
  Kind kind = Kind::kIgnore;
  std::uint16_t pulse_us = 0;

  static ChannelCommand ignore() noexcept { return {}; }
  static ChannelCommand release() noexcept { return {Kind::kRelease, 0}; }
  /// Clamped to kMinPulse_us ... kMaxPulse_us, whatever the caller computed.
  static ChannelCommand pulse(double us) noexcept;
};

/// Index 0 is channel 1.
using ChannelCommands = std::array<ChannelCommand, kRcChannels>;
using RcWire = std::array<std::uint16_t, kRcChannels>;

/// The numbers of the message (MAVLink common.xml, RC_CHANNELS_OVERRIDE): channels 1 to 8: 0 releases, 65535 ignores;
/// channels 9 to 18: 65534 releases, 65535 ignores (0 would ignore as well, so it never releases there).
RcWire to_wire(const ChannelCommands& commands) noexcept;

}  // namespace ajna::flight
