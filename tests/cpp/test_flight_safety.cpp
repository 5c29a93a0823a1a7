// SPDX-License-Identifier: MIT
// The safety machine against an oracle that knows nothing of its states: random events, and each fault by itself.
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/flight/safety.hpp"
#include "safety_world.hpp"

namespace ajna::flight {
namespace {

TEST(Safety, NothingKnownIsNothingAllowed) {
  SafetyMachine machine;
  for (int i = 0; i < 100; ++i) {
    SafetyInputs in;
    in.now_s = 1.0 + i * kTick_s;
    const auto decision = machine.step(in);
    EXPECT_FALSE(decision.send_command);
    EXPECT_FALSE(decision.send_release);
    EXPECT_EQ(decision.state, SafetyState::kStandby);
  }
}

TEST(Safety, TheSwitchMustBeHeldOn) {
  SafetyOptions options;
  SafetyMachine machine(options);
  machine.step(good(10.0));
  double first = 0.0;
  for (double t = 10.01; t < 11.0; t += kTick_s) {
    if (machine.step(on(t)).send_command) {
      first = t;
      break;
    }
  }
  EXPECT_NEAR(first, 10.01 + options.switch_hold_s, kTick_s * 1.01);
}

TEST(Safety, ASwitchThatIsOnFromTheBeginningDoesNothing) {
  SafetyMachine machine;
  for (double t = 10.0; t < 15.0; t += kTick_s) {
    const auto decision = machine.step(on(t));
    EXPECT_FALSE(decision.send_command);
    EXPECT_EQ(decision.fault, Fault::kSwitchNotCycled);
  }
}

TEST(Safety, ASwitchTurnedOnBeforeArmingDoesNothing) {
  SafetyMachine machine;
  double t = 10.0;
  machine.step(good(t));
  for (; t < 11.0; t += kTick_s) {
    auto in = on(t);
    in.armed = false;
    EXPECT_FALSE(machine.step(in).send_command);
  }
  for (; t < 12.0; t += kTick_s) {
    EXPECT_FALSE(machine.step(on(t)).send_command) << "arming must not start it";
  }
  activate(machine, t + kTick_s);
}

TEST(Safety, AMiddlePositionIsNeitherOnNorTurnedOff) {
  SafetyMachine machine;
  double t = 10.0;
  for (; t < 10.5; t += kTick_s) {
    auto in = good(t);
    in.switch_us = 1500;
    EXPECT_FALSE(machine.step(in).send_command);
  }
  for (; t < 11.0; t += kTick_s) {
    EXPECT_FALSE(machine.step(on(t)).send_command);
  }
}

struct Injection {
  const char* name;
  Fault fault;
  std::function<void(SafetyInputs&, double since_s)> apply;
};

/// What stops coming at the moment of the fault keeps the age it had then, and grows older.
std::vector<Injection> injections() {
  const auto set = [](auto member, auto value) {
    return [member, value](SafetyInputs& in, double) { in.*member = value; };
  };
  return {
      {"stop", Fault::kStop, set(&SafetyInputs::stop_requested, true)},
      {"exception", Fault::kInternal, set(&SafetyInputs::internal_error, true)},
      {"output", Fault::kOutput, set(&SafetyInputs::output_ok, false)},
      {"wrong vehicle", Fault::kWrongVehicle, set(&SafetyInputs::right_vehicle, false)},
      {"failsafe", Fault::kAutopilotFailsafe, set(&SafetyInputs::autopilot_failsafe, true)},
      {"link loss", Fault::kNoPilotInput, [](SafetyInputs& in, double s) { in.rc_s = in.now_s - 0.02 - s; }},
      {"no switch", Fault::kNoPilotInput, [](SafetyInputs& in, double) { in.switch_us.reset(); }},
      {"receiver", Fault::kReceiverLost, set(&SafetyInputs::receiver_healthy, false)},
      {"disarm", Fault::kNotArmed, set(&SafetyInputs::armed, false)},
      {"mode", Fault::kModeNotAllowed, set(&SafetyInputs::mode_allowed, false)},
      {"switch off", Fault::kSwitchOff, [](SafetyInputs& in, double) { in.switch_us = 1000; }},
      {"switch middle", Fault::kSwitchOff, [](SafetyInputs& in, double) { in.switch_us = 1500; }},
      {"switch absurd", Fault::kSwitchOff, [](SafetyInputs& in, double) { in.switch_us = 2400; }},
      {"parameters", Fault::kParametersRefused, set(&SafetyInputs::parameters, ParameterState::kRefused)},
      {"restart", Fault::kParametersUnknown, set(&SafetyInputs::parameters, ParameterState::kUnknown)},
      {"ignored", Fault::kOverrideIgnored, set(&SafetyInputs::override_followed, false)},
      {"no model", Fault::kModelNotTested, set(&SafetyInputs::model_tested, false)},
      {"camera stall", Fault::kCameraStale, [](SafetyInputs& in, double s) { in.frame_s = in.now_s - 0.03 - s; }},
      {"no camera", Fault::kCameraStale, [](SafetyInputs& in, double) { in.frame_s.reset(); }},
      {"frame from the future", Fault::kCameraStale, [](SafetyInputs& in, double) { in.frame_s = in.now_s + 1.0; }},
      {"frame time NaN", Fault::kCameraStale, [](SafetyInputs& in, double) { in.frame_s = kNaN; }},
      {"NaN network", Fault::kNetworkInvalid, set(&SafetyInputs::network_ok, false)},
      {"slow network", Fault::kNetworkStale,
       [](SafetyInputs& in, double s) { in.command_frame_s = in.now_s - 0.06 - s; }},
      {"NaN command", Fault::kCommandInvalid, set(&SafetyInputs::command_finite, false)},
  };
}

TEST(Safety, EachFaultReleasesWithin200MsAndStaysReleased) {
  const SafetyOptions options;
  for (const auto& injection : injections()) {
    SCOPED_TRACE(injection.name);
    SafetyMachine machine(options);
    const double began_s = activate(machine) + kTick_s;
    double released_s = kNaN;
    int releases = 0;
    double last_release_s = 0.0;
    for (double t = began_s; t < began_s + 2.0; t += kTick_s) {
      auto in = on(t);
      injection.apply(in, t - began_s);
      const auto decision = machine.step(in);
      if (std::isnan(released_s) && decision.released) {
        released_s = t;
        EXPECT_EQ(decision.fault, injection.fault) << to_string(decision.fault);
        EXPECT_EQ(decision.release_reason, injection.fault);
      }
      EXPECT_FALSE(decision.send_command && decision.send_release);
      EXPECT_FALSE(!std::isnan(released_s) && decision.send_command);
      releases += decision.send_release ? 1 : 0;
      last_release_s = decision.send_release ? t : last_release_s;
    }
    EXPECT_LE(released_s - began_s, 0.2);
    EXPECT_GE(releases, options.release_repeats);
    EXPECT_GE(last_release_s - released_s, options.release_duration_s - kTick_s);
    EXPECT_TRUE(machine.at_rest());
    if (injection.fault == Fault::kSwitchOff && std::string(injection.name) == "switch off") {
      continue;  // turned on again it is a new request
    }
    // All is well again, the switch still on: nothing begins.
    for (double t = began_s + 2.0; t < began_s + 3.0; t += kTick_s) {
      EXPECT_FALSE(machine.step(on(t)).send_command);
    }
    activate(machine, began_s + 3.0);
  }
}

TEST(Safety, HeartbeatLossReleasesEvenIfTheOtherStreamsGoOn) {
  const SafetyOptions options;
  SafetyMachine machine(options);
  const double began_s = activate(machine) + kTick_s;
  double released_s = kNaN;
  for (double t = began_s; t < began_s + 4.0; t += kTick_s) {
    auto in = on(t);
    in.heartbeat_s = began_s - 0.1;
    if (machine.step(in).released) {
      released_s = t;
    }
  }
  EXPECT_NEAR(released_s - (began_s - 0.1), options.heartbeat_timeout_s, 0.03);
}

TEST(Safety, ALateOrBackwardClockReleases) {
  {
    SafetyMachine machine;
    const double t = activate(machine);
    EXPECT_EQ(machine.step(on(t + 0.5)).release_reason, Fault::kLoopLate);
  }
  for (const double jump_s : {-1e-3, -3600.0, kNaN}) {
    SafetyMachine machine;
    const double t = activate(machine);
    const auto decision = machine.step(on(t + jump_s));
    EXPECT_EQ(decision.release_reason, Fault::kClock);
    EXPECT_TRUE(decision.send_release);
    EXPECT_FALSE(machine.step(on(t + jump_s + 0.01)).send_command);
  }
}

TEST(Safety, AReleaseWaitsForTheLink) {
  const SafetyOptions options;
  SafetyMachine machine(options);
  double t = activate(machine) + kTick_s;
  const double broken_s = t;
  for (; t < broken_s + 20.0; t += kTick_s) {
    auto in = on(t);
    in.link_open = in.output_ok = false;
    EXPECT_TRUE(machine.step(in).send_release);
    EXPECT_FALSE(machine.at_rest());
  }
  const double back_s = t;
  int heard = 0;
  for (; !machine.at_rest(); t += kTick_s) {
    ASSERT_LT(t, back_s + 2.0);
    const auto decision = machine.step(on(t));
    EXPECT_FALSE(decision.send_command);
    heard += decision.send_release ? 1 : 0;
  }
  EXPECT_GE(heard, options.release_repeats);
  EXPECT_NEAR(t - back_s, options.release_duration_s, 3 * kTick_s);
  activate(machine, t);
}

TEST(Safety, AProgramThatIsToEndDoesNotWaitForTheLink) {
  const SafetyOptions options;
  SafetyMachine machine(options);
  double t = activate(machine) + kTick_s;
  const double broken_s = t;
  for (; !machine.at_rest(); t += kTick_s) {
    ASSERT_LT(t, broken_s + 2.0);
    auto in = on(t);
    in.link_open = in.output_ok = false;
    in.stop_requested = true;
    machine.step(in);
  }
  EXPECT_GE(t - broken_s, options.release_duration_s);
}

TEST(Safety, OptionsOutOfRangeAreRefused) {
  const auto refused = [](auto member, auto value) {
    SafetyOptions options;
    options.*member = value;
    EXPECT_THROW(SafetyMachine{options}, Error);
  };
  refused(&SafetyOptions::camera_timeout_s, 0.0);
  refused(&SafetyOptions::camera_timeout_s, kNaN);
  refused(&SafetyOptions::rc_timeout_s, 5.0);
  refused(&SafetyOptions::heartbeat_timeout_s, 0.1);
  refused(&SafetyOptions::release_repeats, 1);
  refused(&SafetyOptions::switch_on_min_us, 1000);
  refused(&SafetyOptions::max_tick_s, 2.0);
}

TEST(Safety, EveryFaultHasANameAndASentence) {
  for (int i = 0; i < kFaultCount; ++i) {
    const auto fault = static_cast<Fault>(i);
    EXPECT_STRNE(to_string(fault), "unknown");
    EXPECT_STRNE(explain(fault), "unknown");
  }
}

}  // namespace
}  // namespace ajna::flight
