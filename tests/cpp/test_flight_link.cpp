// SPDX-License-Identifier: MIT
// MAVLink frames by the official parser, and the parameters that are objected to.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "ajna/base/error.hpp"
#include "ajna/flight/codec.hpp"
#include "ajna/flight/echo_check.hpp"
#include "ajna/flight/parameters.hpp"
#include "flight_fixtures.hpp"

namespace ajna::flight {
namespace {

TEST(RcChannels, ReleaseAndIgnoreDifferAboveChannel8) {
  ChannelCommands commands{};
  commands[0] = ChannelCommand::release();
  commands[7] = ChannelCommand::pulse(1234.4);
  commands[8] = ChannelCommand::release();
  commands[17] = ChannelCommand::pulse(1999.6);
  const RcWire wire = to_wire(commands);
  EXPECT_EQ(wire[0], 0);
  EXPECT_EQ(wire[1], 65535);
  EXPECT_EQ(wire[7], 1234);
  EXPECT_EQ(wire[8], 65534);
  EXPECT_EQ(wire[9], 65535);
  EXPECT_EQ(wire[17], 2000);
}

TEST(RcChannels, NoPulseLeavesTheSafeRange) {
  for (const double us : {-1e9, 0.0, 65535.0, 1e9, 999.0, 2001.0}) {
    const auto command = ChannelCommand::pulse(us);
    EXPECT_GE(command.pulse_us, kMinPulse_us);
    EXPECT_LE(command.pulse_us, kMaxPulse_us);
  }
  EXPECT_EQ(ChannelCommand::pulse(std::nan("")).kind, ChannelCommand::Kind::kIgnore);
}

TEST(Codec, HeartbeatIsOfAnOnboardController) {
  MavlinkCodec codec({42, 191, 1, 1});
  const auto message = only(codec.heartbeat(false));
  EXPECT_EQ(message.magic, MAVLINK_STX);
  EXPECT_EQ(message.sysid, 42);
  EXPECT_EQ(message.compid, MAV_COMP_ID_ONBOARD_COMPUTER);
  mavlink_heartbeat_t beat;
  mavlink_msg_heartbeat_decode(&message, &beat);
  EXPECT_EQ(beat.type, MAV_TYPE_ONBOARD_CONTROLLER);
  EXPECT_EQ(beat.autopilot, MAV_AUTOPILOT_INVALID);
  EXPECT_EQ(beat.base_mode, 0);
  EXPECT_EQ(beat.system_status, MAV_STATE_STANDBY);
  const auto second = only(codec.heartbeat(true));
  EXPECT_EQ(second.seq, message.seq + 1);
  mavlink_msg_heartbeat_decode(&second, &beat);
  EXPECT_EQ(beat.system_status, MAV_STATE_ACTIVE);
}

TEST(Codec, OverrideCarriesAll18ChannelsToTheTarget) {
  MavlinkCodec codec({255, 191, 3, 1});
  ChannelCommands commands{};
  commands[1] = ChannelCommand::pulse(1600);
  commands[11] = ChannelCommand::release();
  const auto message = only(codec.rc_override(commands));
  ASSERT_EQ(message.msgid, static_cast<std::uint32_t>(MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE));
  EXPECT_EQ(mavlink_msg_rc_channels_override_get_target_system(&message), 3);
  EXPECT_EQ(mavlink_msg_rc_channels_override_get_target_component(&message), 1);
  const auto wire = override_of(message);
  for (std::size_t i = 0; i < wire.size(); ++i) {
    EXPECT_EQ(wire[i], i == 1 ? 1600 : i == 11 ? 65534 : 65535) << i;
  }
}

TEST(Codec, ReadsWhatAnAutopilotSends) {
  SimulatedAutopilot autopilot;
  MemoryTransport pipe;
  autopilot.run(0.0, pipe);
  const std::vector<std::uint8_t> bytes(pipe.incoming.begin(), pipe.incoming.end());
  MavlinkCodec codec({});
  // In pieces of every size, with noise between the frames.
  std::vector<Received> all;
  std::mt19937 random(1);
  for (std::size_t at = 0; at < bytes.size();) {
    const std::size_t size = std::min<std::size_t>(1 + random() % 7, bytes.size() - at);
    for (auto& one : codec.decode(bytes.data() + at, size)) {
      all.push_back(one);
    }
    at += size;
  }
  ASSERT_EQ(all.size(), 4U);
  const auto& beat = std::get<HeartbeatMessage>(all[0].message);
  EXPECT_TRUE(beat.armed);
  EXPECT_TRUE(beat.is_ardupilot_copter);
  EXPECT_FALSE(beat.failsafe);
  EXPECT_EQ(beat.custom_mode, 5U);
  EXPECT_TRUE(std::get<SysStatusMessage>(all[1].message).rc_receiver_healthy);
  const auto& rc = std::get<RcChannelsMessage>(all[2].message);
  EXPECT_EQ(rc.count, 16);
  EXPECT_EQ(rc.pulse_us[7], 1000);
  const auto& attitude = std::get<AttitudeMessage>(all[3].message);
  EXPECT_NEAR(attitude.euler_rad[2], 1.0, 1e-6);
  EXPECT_NEAR(attitude.rates_rad_s[1], 0.2, 1e-6);
}

TEST(Codec, DamagedBytesAreCountedNeverRead) {
  SimulatedAutopilot autopilot;
  std::mt19937 random(2);
  MavlinkCodec codec({});
  std::size_t whole = 0;
  for (int i = 0; i < 200; ++i) {
    MemoryTransport pipe;
    autopilot.run(i * 2.0, pipe);
    std::vector<std::uint8_t> bytes(pipe.incoming.begin(), pipe.incoming.end());
    const std::size_t at = random() % bytes.size();
    bytes[at] ^= static_cast<std::uint8_t>(1 + random() % 255);
    for (const auto& one : codec.decode(bytes.data(), bytes.size())) {
      ++whole;
      if (const auto* rc = std::get_if<RcChannelsMessage>(&one.message)) {
        EXPECT_EQ(rc->pulse_us[0], 1500);
      }
    }
  }
  EXPECT_GT(codec.bad_frames(), 50U);
  EXPECT_GT(whole, 400U);
  EXPECT_LT(whole, 800U);
}

TEST(Codec, AttitudeTargetIgnoresAllRates) {
  MavlinkCodec codec({});
  const auto message = only(codec.attitude_target({0.1, -0.2, 2.0, 0.75}, 1234));
  mavlink_set_attitude_target_t raw;
  mavlink_msg_set_attitude_target_decode(&message, &raw);
  EXPECT_EQ(raw.type_mask, 7);
  EXPECT_EQ(raw.time_boot_ms, 1234U);
  EXPECT_FLOAT_EQ(raw.thrust, 0.75F);
  EXPECT_NEAR(raw.q[0] * raw.q[0] + raw.q[1] * raw.q[1] + raw.q[2] * raw.q[2] + raw.q[3] * raw.q[3], 1.0, 1e-6);
  float roll = 0.0F, pitch = 0.0F, yaw = 0.0F;
  mavlink_quaternion_to_euler(raw.q, &roll, &pitch, &yaw);
  EXPECT_NEAR(roll, 0.1, 1e-5);
  EXPECT_NEAR(pitch, -0.2, 1e-5);
  EXPECT_NEAR(yaw, 2.0, 1e-5);
}

TEST(Codec, SignedLinksTakeOnlyWhatIsSignedWithTheirKey) {
  SigningKey key;
  key.secret.fill(7);
  key.timestamp_10us = 1000000;
  SigningKey other = key;
  other.secret[31] = 8;
  MavlinkCodec receiver({}, key);
  const auto count = [&](MavlinkCodec& sender) {
    const Bytes bytes = sender.heartbeat(true);
    return receiver.decode(bytes.data(), bytes.size()).size();
  };
  MavlinkCodec good({9, 1, 1, 1}, key);
  MavlinkCodec wrong({10, 1, 1, 1}, other);
  MavlinkCodec unsigned_one({11, 1, 1, 1});
  EXPECT_EQ(count(good), 1U);
  EXPECT_EQ(count(wrong), 0U);
  EXPECT_EQ(count(unsigned_one), 0U);
  EXPECT_EQ(count(good), 1U);
  const Bytes replayed = good.heartbeat(true);
  EXPECT_EQ(receiver.decode(replayed.data(), replayed.size()).size(), 1U);
  EXPECT_EQ(receiver.decode(replayed.data(), replayed.size()).size(), 0U);
}

TEST(Codec, ModesByName) {
  EXPECT_EQ(copter_mode("LOITER"), 5U);
  EXPECT_EQ(copter_mode("GUIDED_NOGPS"), 20U);
  EXPECT_EQ(copter_mode_name(5), "LOITER");
  EXPECT_EQ(copter_mode_name(250), "mode 250");
  try {
    copter_mode("LOITTER");
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("did you mean 'LOITER'"), std::string::npos);
  }
  EXPECT_THROW(MavlinkCodec({0, 1, 1, 1}), Error);
  EXPECT_THROW(MavlinkCodec({256, 1, 1, 1}), Error);
}

// --- parameters ---

ParameterCheck answered(std::map<std::string, double> values, OutputKind output = OutputKind::kRcOverride) {
  ParameterCheck check(output, 255, 3.0);
  for (const auto& [name, value] : values) {
    check.received(name, value);
  }
  return check;
}

TEST(Parameters, GoodOnesPassAndUnknownOnesDoNot) {
  EXPECT_EQ(answered({}).state(), ParameterState::kUnknown);
  EXPECT_EQ(answered({{"SYSID_MYGCS", 255}, {"RC_OVERRIDE_TIME", 3.0}}).state(), ParameterState::kUnknown);
  EXPECT_EQ(answered({{"SYSID_MYGCS", 255}, {"RC_OVERRIDE_TIME", 3.0}, {"RC_OPTIONS", 32}}).state(),
            ParameterState::kOk);
  EXPECT_EQ(answered({{"MAV_GCS_SYSID", 255}, {"RC_OVERRIDE_TIME", 1.0}, {"RC_OPTIONS", 0}}).state(),
            ParameterState::kOk);
  EXPECT_EQ(answered({{"GUID_TIMEOUT", 3.0}, {"GUID_OPTIONS", 0}}, OutputKind::kAttitude).state(), ParameterState::kOk);
}

TEST(Parameters, UnsafeOnesAreRefusedWithAReason) {
  const auto refused = [](std::map<std::string, double> values, const std::string& word,
                          OutputKind output = OutputKind::kRcOverride) {
    std::map<std::string, double> all = {{"SYSID_MYGCS", 255}, {"RC_OVERRIDE_TIME", 3.0}, {"RC_OPTIONS", 32}};
    if (output == OutputKind::kAttitude) {
      all = {{"GUID_TIMEOUT", 3.0}, {"GUID_OPTIONS", 0}};
    }
    for (const auto& [name, value] : values) {
      all[name] = value;
    }
    const auto check = answered(all, output);
    EXPECT_EQ(check.state(), ParameterState::kRefused) << word;
    ASSERT_FALSE(check.reasons().empty());
    EXPECT_NE(check.reasons().front().find(word), std::string::npos) << check.reasons().front();
  };
  refused({{"SYSID_MYGCS", 254}}, "SYSID_MYGCS is 254");
  refused({{"RC_OVERRIDE_TIME", 0.0}}, "disables");
  refused({{"RC_OVERRIDE_TIME", -1.0}}, "never end");
  refused({{"RC_OVERRIDE_TIME", 10.0}}, "outlive");
  refused({{"RC_OVERRIDE_TIME", 0.1}}, "between two");
  refused({{"RC_OPTIONS", 2}}, "ignore our overrides");
  refused({{"RC_OPTIONS", 1}}, "receiver");
  refused({{"GUID_TIMEOUT", 5.0}}, "GUID_TIMEOUT", OutputKind::kAttitude);
  refused({{"GUID_OPTIONS", 8}}, "GUID_OPTIONS", OutputKind::kAttitude);
}

TEST(Parameters, ARangeOfStationsMayIncludeUs) {
  const auto with = [](double low, std::optional<double> high) {
    std::map<std::string, double> values = {{"MAV_GCS_SYSID", low}, {"RC_OVERRIDE_TIME", 1.0}, {"RC_OPTIONS", 0}};
    if (high) {
      values["MAV_GCS_SYSID_HI"] = *high;
    }
    return answered(values).state();
  };
  EXPECT_EQ(with(250, std::nullopt), ParameterState::kUnknown) << "the range is asked for first";
  EXPECT_EQ(with(250, 255), ParameterState::kOk);
  EXPECT_EQ(with(250, 254), ParameterState::kRefused);
  EXPECT_EQ(with(250, 0), ParameterState::kRefused);
}

TEST(Parameters, AskedForOnceASecondUntilAnswered) {
  ParameterCheck check(OutputKind::kRcOverride, 255, 3.0);
  EXPECT_EQ(check.wanted(0.0).size(), 4U);
  EXPECT_TRUE(check.wanted(0.5).empty());
  check.received("RC_OPTIONS", 0);
  EXPECT_EQ(check.wanted(1.0).size(), 3U);
  check.received("SYSID_MYGCS", 255);
  check.received("RC_OVERRIDE_TIME", 1);
  EXPECT_TRUE(check.wanted(2.0).empty());
  check.reset();
  EXPECT_EQ(check.wanted(2.1).size(), 4U);
}

TEST(EchoCheck, NoticesAnAutopilotThatDoesNotFollow) {
  for (const bool follows : {true, false}) {
    EchoCheck echo;
    RcChannelsMessage rc;
    rc.count = 16;
    rc.pulse_us.fill(1500);
    double lost_s = -1.0;
    for (double t = 0.0; t < 10.0; t += 0.04) {
      RcWire sent{};
      sent[0] = static_cast<std::uint16_t>(1500 + 200 * std::sin(t));
      echo.sent(t, sent);
      rc.pulse_us[0] = follows ? static_cast<std::uint16_t>(1500 + 200 * std::sin(t - 0.2)) : std::uint16_t{1500};
      echo.received(t, rc);
      lost_s = lost_s < 0.0 && !echo.followed() ? t : lost_s;
    }
    EXPECT_EQ(echo.followed(), follows);
    if (!follows) {
      EXPECT_LT(lost_s, 3.0);
    }
  }
}

TEST(Endpoint, IsReadOrRefused) {
  const auto serial = parse_endpoint("serial:/dev/ttyAMA0:921600");
  EXPECT_EQ(serial.device, "/dev/ttyAMA0");
  EXPECT_EQ(serial.baud, 921600);
  const auto tcp = parse_endpoint("tcp:127.0.0.1:5760");
  EXPECT_EQ(tcp.kind, Endpoint::Kind::kTcp);
  EXPECT_EQ(tcp.port, 5760);
  for (const char* bad : {"", "udpin", "udpin:1", "udpin::14550", "tcp:host:0", "tcp:host:99999", "tcp:host:x",
                          "serial:/dev/x:12345", "ucp:host:1"}) {
    EXPECT_THROW(parse_endpoint(bad), Error) << bad;
  }
}

}  // namespace
}  // namespace ajna::flight
