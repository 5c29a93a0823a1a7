// SPDX-License-Identifier: MIT
#include "ajna/flight/rc_channels.hpp"

#include <algorithm>
#include <cmath>

namespace ajna::flight {
namespace {

constexpr std::size_t kBaseChannels = 8;  // the message's original fields; the others are a MAVLink 2 extension
constexpr std::uint16_t kIgnoreWire = 65535;
constexpr std::uint16_t kReleaseBase = 0;
constexpr std::uint16_t kReleaseExtension = 65534;

}  // namespace

ChannelCommand ChannelCommand::pulse(double us) noexcept {
  // A value that is not a number says nothing, rather than anything.
  if (!std::isfinite(us)) {
    return ignore();
  }
  const double clamped = std::clamp(us, static_cast<double>(kMinPulse_us), static_cast<double>(kMaxPulse_us));
  return {Kind::kPulse, static_cast<std::uint16_t>(std::lround(clamped))};
}

RcWire to_wire(const ChannelCommands& commands) noexcept {
  RcWire wire{};
  for (std::size_t i = 0; i < commands.size(); ++i) {
    switch (commands[i].kind) {
      case ChannelCommand::Kind::kPulse:
        wire[i] = std::clamp(commands[i].pulse_us, kMinPulse_us, kMaxPulse_us);
        break;
      case ChannelCommand::Kind::kRelease:
        wire[i] = i < kBaseChannels ? kReleaseBase : kReleaseExtension;
        break;
      case ChannelCommand::Kind::kIgnore:
        wire[i] = kIgnoreWire;
        break;
    }
  }
  return wire;
}

}  // namespace ajna::flight
