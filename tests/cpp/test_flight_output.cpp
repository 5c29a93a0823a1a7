// SPDX-License-Identifier: MIT
// What outputs make of commands: signs, limits, rates, releases.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "ajna/base/error.hpp"
#include "ajna/flight/codec.hpp"
#include "ajna/flight/command_output.hpp"
#include "flight_fixtures.hpp"

namespace ajna::flight {
namespace {

using control::Command;

RcWire pulses(CommandOutput& output, const Command& command, double dt_s) {
  MavlinkCodec codec({});
  const auto frame = output.command(codec, command, dt_s, {}, 0);
  return frame ? override_of(only(*frame)) : RcWire{};
}

TEST(RcOutput, SignsAreThoseOfTheSticks) {
  auto output = make_rc_output({});
  const auto settled = [&](const Command& command) {
    output->reset();
    RcWire wire{};
    for (int i = 0; i < 50; ++i) {
      wire = pulses(*output, command, 0.05);
    }
    return wire;
  };
  const auto right = settled(Command::velocity({0.0, 1.0, 0.0}));
  EXPECT_EQ(right[0], 1580);
  EXPECT_EQ(right[1], 1500);
  EXPECT_EQ(right[2], 1500);
  EXPECT_EQ(right[3], 1500);
  EXPECT_EQ(settled(Command::velocity({1.0, 0.0, 0.0}))[1], 1420) << "forward is a low pitch stick";
  EXPECT_EQ(settled(Command::velocity({0.0, 0.0, 1.0}))[2], 1380) << "down is a low throttle stick";
  EXPECT_EQ(settled(Command::velocity({0.0, 0.0, 0.0}, 0.5))[3], 1575) << "to the right is a high yaw stick";
  EXPECT_EQ(settled(Command::hold())[0], 1500);
  for (std::size_t i = 4; i < right.size(); ++i) {
    EXPECT_EQ(right[i], 65535) << "channel " << i + 1;
  }
}

TEST(RcOutput, LimitsHoldForAnyCommandAndAnyTiming) {
  RcOutputOptions options;
  options.sticks[3].channel = 0;  // yaw is the pilot's
  auto output = make_rc_output(options);
  std::mt19937 random(3);
  std::normal_distribution<double> wild(0.0, 50.0);
  std::uniform_real_distribution<double> time(0.0, 0.08);
  RcWire last = {1500, 1500, 1500};
  for (int i = 0; i < 5000; ++i) {
    const double dt_s = time(random);
    const auto wire =
        pulses(*output, Command::velocity({wild(random), wild(random), wild(random)}, wild(random)), dt_s);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const StickOptions& stick = options.sticks[axis];
      EXPECT_GE(wire[axis], stick.min_us);
      EXPECT_LE(wire[axis], stick.max_us);
      EXPECT_LE(std::abs(wire[axis] - last[axis]), stick.rate_us_s * dt_s + 1.0);
    }
    EXPECT_EQ(wire[3], 65535);
    last = wire;
  }
  // A pause, or a clock that has gone mad, lets nothing jump by more than a tenth of a second's worth.
  for (const double dt_s : {1e6, std::nan(""), -5.0}) {
    const auto wire = pulses(*output, Command::hold(), dt_s);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      EXPECT_LE(std::abs(wire[axis] - last[axis]), options.sticks[axis].rate_us_s * 0.1 + 1.0);
    }
    last = wire;
  }
}

TEST(RcOutput, ReleaseFreesExactlyTheOverriddenChannels) {
  RcOutputOptions options;
  options.sticks[3].channel = 12;
  auto output = make_rc_output(options);
  MavlinkCodec codec({});
  const auto wire = override_of(only(output->release(codec, {}, 0)));
  for (std::size_t i = 0; i < wire.size(); ++i) {
    EXPECT_EQ(wire[i], i < 3 ? 0 : i == 11 ? 65534 : 65535) << "channel " << i + 1;
  }
}

TEST(RcOutput, ACommandThatIsNoNumberMakesNoFrame) {
  auto output = make_rc_output({});
  MavlinkCodec codec({});
  auto command = Command::velocity({0.0, std::nan(""), 0.0});
  EXPECT_FALSE(output->command(codec, command, 0.02, {}, 0).has_value());
  command = Command::velocity({0.0, 0.0, 0.0}, std::numeric_limits<double>::infinity());
  EXPECT_FALSE(output->command(codec, command, 0.02, {}, 0).has_value());
}

TEST(RcOutput, BadOptionsAreRefused) {
  const auto refused = [](auto change) {
    RcOutputOptions options;
    change(options.sticks);
    EXPECT_THROW(make_rc_output(options), Error);
  };
  refused([](auto& sticks) { sticks[0].min_us = 900.0; });
  refused([](auto& sticks) { sticks[0].max_us = 2100.0; });
  refused([](auto& sticks) { sticks[0].trim_us = 1900.0; });
  refused([](auto& sticks) { sticks[0].channel = 2; });
  refused([](auto& sticks) { sticks[0].channel = 19; });
  refused([](auto& sticks) { sticks[0].rate_us_s = 0.0; });
  refused([](auto& sticks) { sticks[0].us_per_unit = std::nan(""); });
  refused([](auto& sticks) {
    for (auto& stick : sticks) {
      stick.channel = 0;
    }
  });
}

TEST(AttitudeOutput, TiltClimbAndTheirRatesAreLimited) {
  const AttitudeOutputOptions options;
  auto output = make_attitude_output(options);
  MavlinkCodec codec({});
  VehicleMotion motion;
  EXPECT_FALSE(output->command(codec, Command::hold(), 0.02, motion, 0).has_value()) << "the heading is not known";
  motion.yaw_rad = 1.0;
  float last_roll = 0.0F;
  for (int i = 0; i < 100; ++i) {
    const auto frame = output->command(codec, Command::velocity({100.0, 100.0, -100.0}, 100.0), 0.02, motion, 0);
    mavlink_set_attitude_target_t raw;
    const auto message = only(*frame);
    mavlink_msg_set_attitude_target_decode(&message, &raw);
    float roll = 0.0F, pitch = 0.0F, yaw = 0.0F;
    mavlink_quaternion_to_euler(raw.q, &roll, &pitch, &yaw);
    EXPECT_LE(roll, options.max_tilt_rad + 1e-5);
    EXPECT_GE(pitch, -options.max_tilt_rad - 1e-5) << "forward is nose down";
    EXPECT_LE(roll - last_roll, options.tilt_rate_rad_s * 0.02 + 1e-5);
    EXPECT_LE(raw.thrust, 0.5 + 0.5 * options.max_climb_m_s / options.climb_at_full_m_s + 1e-6);
    EXPECT_LE(std::abs(yaw - 1.0), options.max_yaw_rate_rad_s * 0.2 + 1e-5);
    last_roll = roll;
  }
  EXPECT_NEAR(last_roll, options.max_tilt_rad, 1e-4);
  mavlink_set_attitude_target_t raw;
  const auto message = only(output->release(codec, motion, 0));
  mavlink_msg_set_attitude_target_decode(&message, &raw);
  EXPECT_FLOAT_EQ(raw.thrust, 0.5F);
  float roll = 0.0F, pitch = 0.0F, yaw = 0.0F;
  mavlink_quaternion_to_euler(raw.q, &roll, &pitch, &yaw);
  EXPECT_NEAR(roll, 0.0, 1e-6);
  EXPECT_NEAR(pitch, 0.0, 1e-6);
  EXPECT_NEAR(yaw, 1.0, 1e-5);
}

}  // namespace
}  // namespace ajna::flight
