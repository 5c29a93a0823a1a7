// SPDX-License-Identifier: MIT
// The configuration file: the documented example, and everything that must be refused.
#include <gtest/gtest.h>

#include <fstream>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/flight/codec.hpp"
#include "apps/flight_config.hpp"
#include "io_files.hpp"

namespace ajna::apps {
namespace {

const char* const kSmallest = R"(
model: {path: m.pt}
source: {kind: camera, path: "0"}
mavlink: {endpoint: "serial:/dev/serial0:921600"}
safety: {switch_channel: 8}
)";

/// The message that refuses `text`.
std::string refusal(const std::string& text) {
  try {
    parse_config(text, "test.yaml");
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    return error.what();
  }
  ADD_FAILURE() << "accepted:\n" << text;
  return {};
}

void expect_refused(const std::string& extra, const std::string& word) {
  const std::string message = refusal(std::string(kSmallest) + extra);
  EXPECT_NE(message.find(word), std::string::npos) << message;
  EXPECT_EQ(message.find("configuration 'test.yaml'"), 0U) << message;
}

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const auto at = text.find(from);
  EXPECT_NE(at, std::string::npos);
  return text.replace(at, from.size(), to);
}

TEST(FlightConfig, TheSmallestOneHasSafeDefaults) {
  const auto config = parse_config(kSmallest, "test.yaml");
  EXPECT_EQ(config.loop.allowed_modes, std::vector<std::uint32_t>{flight::copter_mode("LOITER")});
  EXPECT_EQ(config.output, flight::OutputKind::kRcOverride);
  EXPECT_EQ(config.link.ids.system_id, 255);
  EXPECT_EQ(config.engine.threads, 2);
  EXPECT_TRUE(config.log.folder.empty());
  EXPECT_EQ(config.endpoint.baud, 921600);
}

TEST(FlightConfig, WhatIsNotSaidOfTheComputersPaceIsTimed) {
  const auto timed = load_config(AJNA_FLIGHT_EXAMPLE);
  EXPECT_TRUE(timed.timed_rate && timed.timed_latency);
  const auto given = parse_config(std::string(kSmallest) + "task: {planning_rate_hz: 15, latency_s: 0}\n", "test.yaml");
  EXPECT_FALSE(given.timed_rate || given.timed_latency);
  EXPECT_EQ(given.skill.planning_rate_hz, 15.0);
}

TEST(FlightConfig, TheDocumentedExampleIsValidAndStatesTheDefaults) {
  const auto example = load_config(AJNA_FLIGHT_EXAMPLE);
  const auto plain = parse_config(kSmallest, "test.yaml");
  EXPECT_EQ(example.loop.safety.camera_timeout_s, plain.loop.safety.camera_timeout_s);
  EXPECT_EQ(example.loop.safety.rc_timeout_s, plain.loop.safety.rc_timeout_s);
  EXPECT_EQ(example.loop.safety.command_timeout_s, plain.loop.safety.command_timeout_s);
  EXPECT_EQ(example.loop.safety.release_repeats, plain.loop.safety.release_repeats);
  EXPECT_EQ(example.loop.allowed_modes, plain.loop.allowed_modes);
  EXPECT_EQ(example.loop.deadline_s, plain.loop.deadline_s);
  for (std::size_t i = 0; i < flight::kAxes; ++i) {
    EXPECT_EQ(example.rc.sticks[i].channel, plain.rc.sticks[i].channel);
    EXPECT_EQ(example.rc.sticks[i].us_per_unit, plain.rc.sticks[i].us_per_unit);
    EXPECT_EQ(example.rc.sticks[i].min_us, plain.rc.sticks[i].min_us);
    EXPECT_EQ(example.rc.sticks[i].max_us, plain.rc.sticks[i].max_us);
    EXPECT_EQ(example.rc.sticks[i].rate_us_s, plain.rc.sticks[i].rate_us_s);
  }
  EXPECT_EQ(example.attitude.max_tilt_rad, plain.attitude.max_tilt_rad);
  EXPECT_EQ(example.skill.dodge_policy.speed_m_s, plain.skill.dodge_policy.speed_m_s);
  EXPECT_EQ(example.skill.navigate_policy.speed_m_s, plain.skill.navigate_policy.speed_m_s);
  EXPECT_EQ(example.skill.horizon.floor, plain.skill.horizon.floor);
  EXPECT_EQ(example.skill.horizon.per_px, plain.skill.horizon.per_px);
  EXPECT_EQ(example.skill.horizon.least_shift_px, plain.skill.horizon.least_shift_px);
  EXPECT_EQ(example.skill.horizon.saturated, plain.skill.horizon.saturated);
  EXPECT_EQ(example.skill.baseline_share, plain.skill.baseline_share);
  EXPECT_EQ(example.skill.baseline_m, plain.skill.baseline_m);
  EXPECT_EQ(example.skill.shortest_baseline_s, plain.skill.shortest_baseline_s);
  EXPECT_EQ(example.skill.corridor.camera_ahead_m, plain.skill.corridor.camera_ahead_m);
  EXPECT_EQ(example.skill.gap_policy.forward_m_s, plain.skill.gap_policy.forward_m_s);
  EXPECT_EQ(example.skill.last_look_s, plain.skill.last_look_s);
}

TEST(FlightConfig, UnknownKeysAreRefusedWithTheNearest) {
  expect_refused("logs: {}", "did you mean 'log'");
  expect_refused("log: {foldr: x}", "did you mean 'log.folder'");
  expect_refused("output: {rc: {right: {chanel: 1}}}", "output.rc.right.chanel");
  expect_refused("task: {kind: dogde}", "did you mean 'dodge'");
  expect_refused("output: {rc: {yaw: {us_per_m_s: 1}}}", "us_per_rad_s");
  const std::string message = refusal(replaced(kSmallest, "switch_channel: 8", "switch_channel: 8, camera_timeout: 1"));
  EXPECT_NE(message.find("line 5"), std::string::npos) << message;
  EXPECT_NE(message.find("camera_timeout_s"), std::string::npos) << message;
}

TEST(FlightConfig, ValuesOutOfRangeAreRefused) {
  expect_refused("log: {frame_every: -1}", "frame_every");
  expect_refused("log: {frame_every: 1.5}", "no whole number");
  expect_refused("log: {max_mib: .nan}", "no finite number");
  expect_refused("log: {folder: [a]}", "give one value");
  expect_refused("log: {folder: }", "no value");
  expect_refused("log: 5", "mapping");
  expect_refused("threads: {tick_s: 1}", "tick_s");
  expect_refused("threads: {control_cpus: 3}", "list");
  expect_refused("threads: {control_cpus: [-1]}", "CPU");
  expect_refused("task: {use_attitude: yes}", "neither true nor false");
  expect_refused("task: {horizontal_fov_rad: 4}", "fov");
  expect_refused("task: {kind: navigate, navigate: {horizon: {per_px: 0}}}", "horizon.per_px");
  expect_refused("output: {rc: {right: {min_us: 500}}}", "1000 to 2000");
  expect_refused("output: {rc: {right: {channel: 8}}}", "must stay the pilot's");
  expect_refused("output: {rc: {right: {channel: 2}}}", "two axes");
  expect_refused("output: {attitude: {max_tilt_rad: 2}}", "max_tilt_rad");
  expect_refused("output: {kind: sticks}", "rc_override");
  expect_refused("simulation: {time_scale: 0}", "0.01 to 1");
}

TEST(FlightConfig, ASlowClockIsForSimulationsOnly) {
  expect_refused("simulation: {time_scale: 0.5}", "127.0.0.1");
  std::string text = replaced(kSmallest, "serial:/dev/serial0:921600", "udpout:127.0.0.1:14550");
  EXPECT_EQ(parse_config(text + "simulation: {time_scale: 0.5}", "test.yaml").time_scale, 0.5);
  text = replaced(kSmallest, "serial:/dev/serial0:921600", "udpin:0.0.0.0:14550");
  EXPECT_NE(refusal(text + "simulation: {time_scale: 0.5}").find("127.0.0.1"), std::string::npos);
}

TEST(FlightConfig, EachNeededKeyIsAskedFor) {
  for (const char* key : {"path: m.pt", "kind: camera, ", ", path: \"0\"", "endpoint: \"serial:/dev/serial0:921600\"",
                          "switch_channel: 8"}) {
    EXPECT_NE(refusal(replaced(kSmallest, key, "")).find("this key is needed"), std::string::npos) << key;
  }
  refusal("");
  refusal("- 1");
  EXPECT_NE(refusal("model: {path: [").find("line"), std::string::npos);
  EXPECT_NE(refusal(std::string(kSmallest) + "log: {}\nlog: {}").find("twice"), std::string::npos);
  EXPECT_NE(refusal(replaced(kSmallest, "switch_channel: 8", "switch_channel: 8, allowed_modes: [LOITR]"))
                .find("did you mean 'LOITER'"),
            std::string::npos);
  EXPECT_NE(refusal(replaced(kSmallest, "switch_channel: 8", "switch_channel: 8, allowed_modes: []"))
                .find("at least one flight mode"),
            std::string::npos);
  EXPECT_NE(refusal(replaced(kSmallest, "921600\"", "921600\", system_id: 300")).find("system_id 300"),
            std::string::npos);
  EXPECT_NE(refusal(replaced(kSmallest, "921600\"", "1234\"")).find("baud rate"), std::string::npos);
}

TEST(FlightConfig, AttitudeOutputMeansTheGuidedModes) {
  const auto config = parse_config(std::string(kSmallest) + "output: {kind: attitude}", "test.yaml");
  EXPECT_EQ(config.loop.allowed_modes,
            (std::vector<std::uint32_t>{flight::copter_mode("GUIDED"), flight::copter_mode("GUIDED_NOGPS")}));
}

TEST(FlightConfig, FilesAreNamedWhereTheyAreMissing) {
  EXPECT_THROW(load_config("/nonexistent.yaml"), Error);
  const io::testing::TempFolder folder;
  EXPECT_THROW(load_signing_key((folder / "none").string()), Error);
  std::ofstream(folder / "short") << "abc";
  EXPECT_THROW(load_signing_key((folder / "short").string()), Error);
  std::ofstream(folder / "key") << std::string(62, '0') << "ff\n";
  const auto key = load_signing_key((folder / "key").string());
  EXPECT_EQ(key.secret[30], 0);
  EXPECT_EQ(key.secret[31], 255);
  EXPECT_GT(key.timestamp_10us, 30000000000000ULL);
}

}  // namespace
}  // namespace ajna::apps
