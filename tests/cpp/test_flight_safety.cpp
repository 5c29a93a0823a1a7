// SPDX-License-Identifier: MIT
// The safety machine against an oracle that knows nothing of its states: random events, and each fault by itself.
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/flight/safety.hpp"

namespace ajna::flight {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kTick_s = 0.01;

/// A world in which all is well at `now_s`, the switch off.
SafetyInputs good(double now_s) {
  SafetyInputs in;
  in.now_s = now_s;
  in.output_ok = true;
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

SafetyInputs on(double now_s) {
  SafetyInputs in = good(now_s);
  in.switch_us = 2000;
  return in;
}

/// Through the switch's off and on until commands go out; the time of the last tick.
double activate(SafetyMachine& machine, double from_s = 100.0) {
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

/// Everything that must hold at this very tick for a command, written down anew from the documentation.
bool all_well(const SafetyInputs& in, const SafetyOptions& options, double last_s) {
  const auto recent = [&](const std::optional<double>& then_s, double limit_s) {
    return then_s && in.now_s - *then_s <= limit_s && *then_s < in.now_s + 0.05;
  };
  return !in.stop_requested && !in.internal_error && in.output_ok && in.right_vehicle && !in.autopilot_failsafe &&
         in.receiver_healthy && in.armed && in.mode_allowed && in.switch_us &&
         *in.switch_us >= options.switch_on_min_us && in.parameters == ParameterState::kOk && in.override_followed &&
         in.model_tested && in.network_ok && in.command_finite && recent(in.heartbeat_s, options.heartbeat_timeout_s) &&
         recent(in.rc_s, options.rc_timeout_s) && recent(in.frame_s, options.camera_timeout_s) &&
         recent(in.command_frame_s, options.command_timeout_s) && in.now_s >= last_s &&
         in.now_s - last_s <= options.max_tick_s;
}

/// A vehicle, a pilot and a camera that do anything at any time, mostly the right thing.
class RandomWorld {
 public:
  explicit RandomWorld(unsigned seed) : random_(seed) {}

  SafetyInputs next() {
    now_s_ += chance(0.002) ? 0.3 : uniform(0.005, 0.03);
    toggle(in_.armed, 0.004, 0.02);
    toggle(in_.mode_allowed, 0.004, 0.05);
    toggle(in_.right_vehicle, 0.001, 0.1);
    toggle(in_.receiver_healthy, 0.001, 0.1);
    toggle(in_.output_ok, 0.002, 0.1);
    toggle(in_.model_tested, 0.0005, 0.1);
    toggle(in_.network_ok, 0.004, 0.2);
    toggle(in_.command_finite, 0.002, 0.2);
    toggle(in_.override_followed, 0.001, 0.1);
    in_.autopilot_failsafe = in_.autopilot_failsafe ? !chance(0.1) : chance(0.001);
    in_.internal_error = in_.internal_error ? !chance(0.05) : chance(0.0005);
    if (chance(0.02)) {
      in_.switch_us = std::vector<std::optional<int>>{1000, 1000, 1500, 2000, 2000, 2000, std::nullopt}[below(7)];
    }
    if (chance(0.003)) {
      in_.parameters = std::vector<ParameterState>{ParameterState::kOk, ParameterState::kOk, ParameterState::kOk,
                                                   ParameterState::kUnknown, ParameterState::kRefused}[below(5)];
    }
    stalled(rc_stalled_, 0.004, in_.rc_s, 0.04);
    stalled(camera_stalled_, 0.004, in_.frame_s, 0.03);
    stalled(network_stalled_, 0.004, in_.command_frame_s, 0.06);
    stalled(heart_stalled_, 0.001, in_.heartbeat_s, 0.1);
    in_.now_s = now_s_;
    return in_;
  }

 private:
  double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(random_); }
  bool chance(double p) { return uniform(0.0, 1.0) < p; }
  std::size_t below(std::size_t n) { return std::uniform_int_distribution<std::size_t>(0, n - 1)(random_); }
  void toggle(bool& value, double break_chance, double repair_chance) {
    value = value ? !chance(break_chance) : chance(repair_chance);
  }
  void stalled(bool& is_stalled, double chance_of, std::optional<double>& then_s, double age_s) {
    is_stalled = is_stalled ? !chance(0.03) : chance(chance_of);
    if (!is_stalled) {
      then_s = now_s_ - uniform(0.0, age_s);
    }
  }

  std::mt19937 random_;
  double now_s_ = 1000.0;
  SafetyInputs in_ = [] {
    SafetyInputs in = good(1000.0);
    in.armed = false;
    return in;
  }();
  bool rc_stalled_ = false, camera_stalled_ = false, network_stalled_ = false, heart_stalled_ = false;
};

TEST(Safety, RandomEventsNeverLetACommandThrough) {
  const SafetyOptions options;
  long commands = 0;
  long releases = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomWorld world(seed);
    SafetyMachine machine(options);
    double last_s = 0.0;
    bool was_active = false;
    bool off_seen = false;  // with everything else known
    double release_from_s = kNaN;
    for (int i = 0; i < 5000; ++i) {
      const SafetyInputs in = world.next();
      const SafetyDecision decision = machine.step(in);
      ASSERT_FALSE(decision.send_command && decision.send_release);
      const bool well = all_well(in, options, i == 0 ? in.now_s : last_s);
      if (decision.send_command) {
        ++commands;
        ASSERT_TRUE(well) << "a command was sent although " << to_string(decision.fault);
        ASSERT_TRUE(was_active || off_seen) << "it began without the switch having been off";
        off_seen = false;
        was_active = true;
      } else if (was_active) {
        ASSERT_TRUE(decision.send_release) << "what was active ended without a release";
        ASSERT_TRUE(decision.released);
        ASSERT_FALSE(well) << "it ended although all was well";
        was_active = false;
        off_seen = false;
        release_from_s = in.now_s;
      }
      if (decision.send_release) {
        ++releases;
        ASSERT_FALSE(std::isnan(release_from_s)) << "a release of what never was";
      } else if (!std::isnan(release_from_s) && !decision.send_command) {
        ASSERT_GE(last_s - release_from_s + 1e-9, options.release_duration_s - 0.3) << "the release ended early";
      }
      if (!was_active && in.switch_us && *in.switch_us <= options.switch_off_max_us) {
        off_seen = true;
      }
      if (decision.activated) {
        release_from_s = kNaN;
      }
      last_s = in.now_s;
    }
  }
  // The world is one in which the machine has something to do.
  EXPECT_GT(commands, 10000);
  EXPECT_GT(releases, 1000);
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
