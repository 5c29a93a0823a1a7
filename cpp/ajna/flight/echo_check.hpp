// SPDX-License-Identifier: MIT
#pragma once

#include <deque>
#include <optional>

#include "ajna/flight/codec.hpp"
#include "ajna/flight/rc_channels.hpp"

namespace ajna::flight {

/// Whether the autopilot does what the override says: its RC_CHANNELS must show the pulses that we sent. It drops
/// overrides of a wrong system id without a word, so this is the only proof that they arrive. Pure.
class EchoCheck {
 public:
  void reset();
  void sent(double now_s, const RcWire& pulses);
  void received(double now_s, const RcChannelsMessage& rc);
  /// False once a channel has stayed away from all that was sent lately, for a second.
  [[nodiscard]] bool followed() const noexcept { return followed_; }

 private:
  struct Sent {
    double time_s;
    RcWire pulses;
  };
  std::deque<Sent> sent_;
  std::optional<double> began_s_;
  std::optional<double> away_since_s_;
  bool followed_ = true;
};

}  // namespace ajna::flight
