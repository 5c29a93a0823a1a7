// SPDX-License-Identifier: MIT
#include "ajna/flight/echo_check.hpp"

#include <algorithm>

namespace ajna::flight {
namespace {

constexpr double kWindow_s = 0.7;  // a command may take so long to show up in the stream
constexpr double kPatience_s = 1.0;
constexpr int kTolerance_us = 25;

}  // namespace

void EchoCheck::reset() {
  sent_.clear();
  began_s_.reset();
  away_since_s_.reset();
  followed_ = true;
}

void EchoCheck::sent(double now_s, const RcWire& pulses) {
  if (!began_s_) {
    began_s_ = now_s;
  }
  sent_.push_back({now_s, pulses});
  while (now_s - sent_.front().time_s > kWindow_s) {
    sent_.pop_front();
  }
}

void EchoCheck::received(double now_s, const RcChannelsMessage& rc) {
  if (!began_s_ || now_s - *began_s_ < kPatience_s || sent_.empty()) {
    return;
  }
  bool away = false;
  for (std::size_t i = 0; i < rc.pulse_us.size(); ++i) {
    if (sent_.back().pulses[i] == 0) {
      continue;
    }
    int low = kMaxPulse_us;
    int high = kMinPulse_us;
    for (const auto& one : sent_) {
      low = std::min<int>(low, one.pulses[i]);
      high = std::max<int>(high, one.pulses[i]);
    }
    away = away || rc.pulse_us[i] < low - kTolerance_us || rc.pulse_us[i] > high + kTolerance_us;
  }
  if (!away) {
    away_since_s_.reset();
  } else if (!away_since_s_) {
    away_since_s_ = now_s;
  } else if (now_s - *away_since_s_ >= kPatience_s) {
    followed_ = false;
  }
}

}  // namespace ajna::flight
