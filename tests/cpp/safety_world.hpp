// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>

#include <limits>

#include "ajna/flight/safety.hpp"

// A world in which a vehicle may be flown, for the tests of the safety machine.

namespace ajna::flight {

inline constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
inline constexpr double kTick_s = 0.01;

/// A world in which all is well at `now_s`, the switch off.
inline SafetyInputs good(double now_s) {
  SafetyInputs in;
  in.now_s = now_s;
  in.link_open = in.output_ok = true;
  in.heartbeat_s = now_s - 0.1;
  in.right_vehicle = true;
  in.autopilot_failsafe = false;
  in.rc_s = now_s - 0.02;
  in.receiver_healthy = true;
  in.armed = true;
  in.mode_allowed = true;
  in.switch_us = 1000;
  in.parameters = ParameterState::kOk;
  in.model_tested = true;
  in.frame_s = now_s - 0.03;
  in.network_ok = true;
  in.command_frame_s = now_s - 0.06;
  in.command_finite = true;
  return in;
}

inline SafetyInputs on(double now_s) {
  SafetyInputs in = good(now_s);
  in.switch_us = 2000;
  return in;
}

/// Through the switch's off and on until commands go out; the time of the last tick.
inline double activate(SafetyMachine& machine, double from_s = 100.0) {
  double now_s = from_s;
  for (int i = 0; i < 5; ++i, now_s += kTick_s) {
    EXPECT_FALSE(machine.step(good(now_s)).send_command);
  }
  for (int i = 0; i < 100; ++i, now_s += kTick_s) {
    if (machine.step(on(now_s)).send_command) {
      return now_s;
    }
  }
  ADD_FAILURE() << "never became active";
  return now_s;
}

}  // namespace ajna::flight
