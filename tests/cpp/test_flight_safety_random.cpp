// SPDX-License-Identifier: MIT
// The safety machine in worlds in which anything may break at any time.
#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "ajna/flight/safety.hpp"
#include "safety_world.hpp"

namespace ajna::flight {
namespace {

/// Everything that must hold at this very tick for a command, written down anew from the documentation.
bool all_well(const SafetyInputs& in, const SafetyOptions& options, double last_s) {
  const auto recent = [&](const std::optional<double>& then_s, double limit_s) {
    return then_s && in.now_s - *then_s <= limit_s && *then_s < in.now_s + 0.05;
  };
  return !in.stop_requested && !in.internal_error && in.link_open && in.output_ok && in.right_vehicle &&
         !in.autopilot_failsafe && in.receiver_healthy && in.armed && in.mode_allowed && in.switch_us &&
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
    toggle(in_.link_open, 0.002, 0.05);
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

}  // namespace
}  // namespace ajna::flight
