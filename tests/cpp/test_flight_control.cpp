// SPDX-License-Identifier: MIT
// The control loop against a simulated autopilot, in simulated time.
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "ajna/flight/control_loop.hpp"
#include "flight_fixtures.hpp"

namespace ajna::flight {
namespace {

using control::Command;

constexpr double kTick_s = 0.01;

LoopOptions loop_options() {
  LoopOptions options;
  options.allowed_modes = {COPTER_MODE_LOITER};
  options.width = 32;
  options.height = 24;
  return options;
}

class ControlLoopTest : public ::testing::Test {
 protected:
  ControlLoopTest() { autopilot.switch_channel = options.switch_channel; }

  void make() {
    auto transport = std::make_unique<MemoryTransport>();
    pipe = transport.get();
    LinkOptions link_options;
    link_options.listen_only = options.dry_run;
    link = std::make_unique<Link>(std::move(transport), link_options, OutputKind::kRcOverride);
    output = make_rc_output({});
    loop = std::make_unique<ControlLoop>(options, *link, *output, board, nullptr,
                                         [this](Level, const std::string& text) { said += text + "\n"; });
  }

  /// Run for a while; `each` may interfere before each tick.
  void run(double seconds, const std::function<void()>& each = {}) {
    for (const double end_s = now_s + seconds; now_s < end_s; now_s += kTick_s) {
      if (each) {
        each();
      }
      if (!camera_stalled && now_s - frame_s >= 0.033) {
        frame_s = now_s;
        board.frame_came(now_s);
      }
      if (!network_stalled && frame_s > made_s && now_s - frame_s >= 0.02) {
        made_s = frame_s;
        board.command_made(command, frame_s);
      }
      autopilot.run(now_s, *pipe);
      const bool flown = autopilot.armed && autopilot.mode == COPTER_MODE_LOITER;
      safe_s = flown ? -1.0 : safe_s < 0.0 ? now_s : safe_s;
      decision = loop->tick(now_s);
      check_what_was_sent();
    }
    autopilot.run(now_s, *pipe);
  }

  /// No frame that overrides goes out but in the active state, and none beyond the limits.
  void check_what_was_sent() {
    for (const auto& message : parse_all(pipe->outgoing)) {
      if (message.msgid != MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE) {
        continue;
      }
      const auto wire = override_of(message);
      const bool overrides = wire[0] != 0 && wire[0] != 65535;
      if (overrides) {
        ++overrides_sent;
        last_override_s = now_s;
        EXPECT_EQ(decision.state, SafetyState::kActive);
        EXPECT_TRUE(safe_s < 0.0 || now_s - safe_s < 0.2) << "although disarmed or in another mode";
        for (std::size_t i = 0; i < 4; ++i) {
          EXPECT_GE(wire[i], 1200);
          EXPECT_LE(wire[i], 1800);
        }
      } else {
        EXPECT_EQ(wire[0], 0);
        first_release_s = first_release_s < 0.0 ? now_s : first_release_s;
      }
    }
  }

  void activate() {
    autopilot.switch_us = 1000;
    run(3.0);
    autopilot.switch_us = 2000;
    run(0.5);
    ASSERT_EQ(decision.state, SafetyState::kActive) << said;
    first_release_s = -1.0;
  }

  /// The fault begins now: a release within 200 ms, and then no override any more.
  void expect_release(Fault fault) {
    const double began_s = now_s;
    run(2.0);
    EXPECT_EQ(decision.release_reason, fault) << said;
    ASSERT_GE(first_release_s, 0.0) << said;
    EXPECT_LE(first_release_s - began_s, 0.2);
    EXPECT_LE(last_override_s, first_release_s);
    for (const auto pulse : autopilot.overridden()) {
      EXPECT_EQ(pulse, 0);
    }
  }

  LoopOptions options = loop_options();
  SimulatedAutopilot autopilot;
  Blackboard board;
  Command command = Command::velocity({0.0, 1.0, 0.0});
  std::unique_ptr<Link> link;
  std::unique_ptr<CommandOutput> output;
  std::unique_ptr<ControlLoop> loop;
  MemoryTransport* pipe = nullptr;
  SafetyDecision decision;
  std::string said;
  double now_s = 50.0, frame_s = 0.0, made_s = 0.0, first_release_s = -1.0, last_override_s = -1.0;
  double safe_s = -1.0;  ///< since when nothing may be sent
  int overrides_sent = 0;
  bool camera_stalled = false, network_stalled = false;
};

TEST_F(ControlLoopTest, CommandsReachTheAutopilotAndEndWithTheSwitch) {
  make();
  activate();
  run(1.0);
  EXPECT_EQ(autopilot.overridden()[0], 1580) << "1 m/s to the right";
  EXPECT_EQ(autopilot.overridden()[1], 1500);
  EXPECT_EQ(autopilot.overridden()[7], 0) << "the switch is not touched";
  // 25 to 60 a second: more than one in every two RC_OVERRIDE_TIMEs, less than floods a serial line.
  EXPECT_GT(overrides_sent, 30);
  EXPECT_LT(overrides_sent, 100);
  autopilot.switch_us = 1000;
  expect_release(Fault::kSwitchOff);
}

TEST_F(ControlLoopTest, HeartbeatsComeOnceASecondAllTheTime) {
  make();
  run(10.0);
  int beats = 0;
  for (const auto& message : autopilot.heard) {
    beats += message.msgid == MAVLINK_MSG_ID_HEARTBEAT ? 1 : 0;
  }
  EXPECT_GE(beats, 10);
  EXPECT_LE(beats, 11);
  EXPECT_EQ(overrides_sent, 0);
}

TEST_F(ControlLoopTest, Disarm) {
  make();
  activate();
  autopilot.armed = false;
  expect_release(Fault::kNotArmed);
}

TEST_F(ControlLoopTest, ModeChange) {
  make();
  activate();
  autopilot.mode = COPTER_MODE_ALT_HOLD;
  expect_release(Fault::kModeNotAllowed);
}

TEST_F(ControlLoopTest, FailsafeOfTheAutopilot) {
  make();
  activate();
  autopilot.state = MAV_STATE_CRITICAL;
  expect_release(Fault::kAutopilotFailsafe);
}

TEST_F(ControlLoopTest, LossOfTheReceiver) {
  make();
  activate();
  autopilot.receiver_healthy = false;
  expect_release(Fault::kReceiverLost);
}

TEST_F(ControlLoopTest, CameraStall) {
  make();
  activate();
  camera_stalled = true;
  expect_release(Fault::kCameraStale);
}

TEST_F(ControlLoopTest, NetworkStall) {
  make();
  activate();
  network_stalled = true;
  expect_release(Fault::kNetworkStale);
}

TEST_F(ControlLoopTest, NetworkFailure) {
  make();
  activate();
  network_stalled = true;
  board.network_failed();
  expect_release(Fault::kNetworkInvalid);
}

TEST_F(ControlLoopTest, CommandThatIsNoNumber) {
  make();
  activate();
  command = Command::velocity({0.0, std::nan(""), 0.0});
  expect_release(Fault::kCommandInvalid);
}

TEST_F(ControlLoopTest, LinkLoss) {
  make();
  activate();
  autopilot.silent = true;
  expect_release(Fault::kNoPilotInput);
}

TEST_F(ControlLoopTest, InternalError) {
  make();
  activate();
  board.internal_error = true;
  expect_release(Fault::kInternal);
}

TEST_F(ControlLoopTest, StopReleasesAndOnlyThenIsDone) {
  make();
  activate();
  board.stop = true;
  EXPECT_FALSE(loop->done());
  expect_release(Fault::kStop);
  EXPECT_TRUE(loop->done());
}

TEST_F(ControlLoopTest, BrokenOutputReleasesAsSoonAsItTakesDataAgain) {
  for (const bool closed : {false, true}) {
    for (const double duration_s : {0.2, 0.7, 10.0}) {
      SCOPED_TRACE((closed ? "closed for " : "full for ") + std::to_string(duration_s) + " s");
      make();
      activate();
      pipe->broken = true;
      pipe->open = !closed;
      run(duration_s);
      EXPECT_EQ(decision.release_reason, Fault::kOutput);
      EXPECT_EQ(decision.state, SafetyState::kReleasing);
      EXPECT_LT(first_release_s, 0.0) << "nobody can have heard it";
      pipe->broken = false;
      pipe->open = true;
      const double back_s = now_s;
      run(1.0);
      EXPECT_GE(first_release_s, back_s);
      EXPECT_LE(first_release_s, back_s + 0.05);
      EXPECT_EQ(autopilot.overridden()[0], 0);
      EXPECT_EQ(decision.state, SafetyState::kStandby);
    }
  }
}

TEST_F(ControlLoopTest, OverridesThatAreIgnoredAreNoticed) {
  make();
  autopilot.follows = false;
  activate();
  run(4.0);
  EXPECT_EQ(decision.release_reason, Fault::kOverrideIgnored);
  EXPECT_NE(said.find("MAV_GCS_SYSID"), std::string::npos) << said;
}

TEST_F(ControlLoopTest, AWrongSystemIdIsSaidAndNothingIsSent) {
  make();
  autopilot.parameters["SYSID_MYGCS"] = 42;
  run(3.0);
  autopilot.switch_us = 2000;
  run(3.0);
  EXPECT_EQ(overrides_sent, 0);
  EXPECT_EQ(decision.fault, Fault::kParametersRefused);
  EXPECT_NE(said.find("SYSID_MYGCS is 42 but mavlink.system_id is 255"), std::string::npos) << said;
}

TEST_F(ControlLoopTest, AnAutopilotThatDoesNotTellItsParametersIsNotFlown) {
  make();
  autopilot.parameters.clear();
  run(3.0);
  autopilot.switch_us = 2000;
  run(3.0);
  EXPECT_EQ(overrides_sent, 0);
  EXPECT_EQ(decision.fault, Fault::kParametersUnknown);
}

TEST_F(ControlLoopTest, AnotherSystemIsHeardButNotFlown) {
  make();
  autopilot.system_id = 7;
  run(3.0);
  autopilot.switch_us = 2000;
  run(3.0);
  EXPECT_EQ(overrides_sent, 0);
  EXPECT_EQ(decision.fault, Fault::kLinkLost);
  EXPECT_NE(said.find("copter of system id 7"), std::string::npos) << said;
}

TEST_F(ControlLoopTest, DryRunWritesNotAByte) {
  options.dry_run = true;
  make();
  activate();
  run(2.0);
  autopilot.switch_us = 1000;
  run(2.0);
  EXPECT_TRUE(autopilot.heard.empty());
}

TEST_F(ControlLoopTest, TheFirstCommandAfterAnActivationIsHold) {
  make();
  command = Command::velocity({0.0, 3.0, 0.0});
  autopilot.switch_us = 1000;
  run(3.0);
  network_stalled = true;  // the newest command is from before the activation ...
  board.command_made(command, now_s);
  autopilot.switch_us = 2000;
  run(0.14);
  ASSERT_EQ(decision.state, SafetyState::kActive) << said;
  EXPECT_EQ(autopilot.overridden()[0], 1500) << "... and was not made for it";
}

}  // namespace
}  // namespace ajna::flight
