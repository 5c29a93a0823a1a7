// SPDX-License-Identifier: MIT
#include "apps/flight_config.hpp"

#include <chrono>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "ajna/base/error.hpp"
#include "ajna/flight/codec.hpp"
#include "apps/yaml_section.hpp"

namespace ajna::apps {
namespace {

/// The file with its line, for errors that come out of the libraries' own validation.
template <typename Function>
auto with_file(const std::string& name, Function function) {
  try {
    return function();
  } catch (const Error& error) {
    const std::string text = error.what();
    if (text.rfind("configuration '", 0) == 0) {
      throw;
    }
    throw_invalid("configuration '" + name + "': " + text);
  }
}

void need(const YamlSection& section, const std::string& key) {
  if (!section.has(key)) {
    section.refuse(key, "this key is needed: see the commented example, docs/flight.yaml");
  }
}

void read_model(YamlSection section, FlightConfig& config) {
  need(section, "path");
  section.read("path", config.model_path);
  section.read("device", config.engine.device);
  section.read("threads", config.engine.threads);
  section.read("bfloat16", config.engine.bfloat16);
  section.read("width_px", config.loop.width);
  section.read("height_px", config.loop.height);
  section.read("deadline_s", config.loop.deadline_s);
  section.finish();
}

void read_source(YamlSection section, FlightConfig& config) {
  need(section, "kind");
  need(section, "path");
  int kind = static_cast<int>(config.source.kind);
  section.read_choice("kind", {"folder", "video", "camera", "gstreamer", "spool"}, kind);
  config.source.kind = static_cast<flight::SourceKind>(kind);
  section.read("path", config.source.path);
  section.read("rate_hz", config.source.rate_hz);
  section.read("width_px", config.source.width);
  section.read("height_px", config.source.height);
  section.read("latency_s", config.source.latency_s);
  if (!(config.source.rate_hz > 0.0 && config.source.rate_hz <= 1000.0)) {
    section.refuse("rate_hz", "give above 0 and at most 1000");
  }
  if (config.source.latency_s < 0.0 || config.source.latency_s > 0.5) {
    section.refuse("latency_s", "give 0 to 0.5");
  }
  if (config.source.width < 0 || config.source.height < 0) {
    section.refuse("width_px", "give a positive size, or 0 for the camera's own");
  }
  section.read("max_damaged_frames", config.loop.max_damaged_frames);
  section.finish();
}

void read_mavlink(YamlSection section, FlightConfig& config) {
  need(section, "endpoint");
  section.read("endpoint", config.endpoint_text);
  config.endpoint = flight::parse_endpoint(config.endpoint_text);
  section.read("system_id", config.link.ids.system_id);
  section.read("component_id", config.link.ids.component_id);
  section.read("target_system", config.link.ids.target_system);
  section.read("target_component", config.link.ids.target_component);
  section.read("heartbeat_rate_hz", config.link.heartbeat_rate_hz);
  section.read("rc_rate_hz", config.link.rc_rate_hz);
  section.read("attitude_rate_hz", config.link.attitude_rate_hz);
  section.read("max_override_s", config.link.max_override_s);
  section.read("signing_key_file", config.signing_key_file);
  if (config.link.heartbeat_rate_hz < 1.0 || config.link.heartbeat_rate_hz > 50.0) {
    section.refuse("heartbeat_rate_hz", "give 1 to 50");
  }
  if (config.link.rc_rate_hz < 10.0 || config.link.rc_rate_hz > 100.0) {
    section.refuse("rc_rate_hz", "give 10 to 100");
  }
  if (config.link.attitude_rate_hz < 10.0 || config.link.attitude_rate_hz > 400.0) {
    section.refuse("attitude_rate_hz", "give 10 to 400");
  }
  if (config.link.max_override_s < 0.2 || config.link.max_override_s > 10.0) {
    section.refuse("max_override_s", "give 0.2 to 10");
  }
  const flight::MavlinkCodec checked(config.link.ids);  // throws for ids out of range
  section.finish();
}

void read_stick(YamlSection section, const char* per_unit, flight::StickOptions& stick) {
  section.read("channel", stick.channel);
  section.read("trim_us", stick.trim_us);
  section.read(per_unit, stick.us_per_unit);
  section.read("min_us", stick.min_us);
  section.read("max_us", stick.max_us);
  section.read("rate_us_s", stick.rate_us_s);
  section.finish();
}

void read_output(YamlSection section, FlightConfig& config) {
  int kind = static_cast<int>(config.output);
  section.read_choice("kind", {"rc_override", "attitude"}, kind);
  config.output = static_cast<flight::OutputKind>(kind);
  YamlSection rc = section.section("rc");
  read_stick(rc.section("right"), "us_per_m_s", config.rc.sticks[0]);
  read_stick(rc.section("forward"), "us_per_m_s", config.rc.sticks[1]);
  read_stick(rc.section("up"), "us_per_m_s", config.rc.sticks[2]);
  read_stick(rc.section("yaw"), "us_per_rad_s", config.rc.sticks[3]);
  rc.finish();
  YamlSection attitude = section.section("attitude");
  attitude.read("max_tilt_rad", config.attitude.max_tilt_rad);
  attitude.read("tilt_rate_rad_s", config.attitude.tilt_rate_rad_s);
  attitude.read("velocity_gain_per_s", config.attitude.velocity_gain_per_s);
  attitude.read("climb_at_full_m_s", config.attitude.climb_at_full_m_s);
  attitude.read("max_climb_m_s", config.attitude.max_climb_m_s);
  attitude.read("climb_rate_m_s2", config.attitude.climb_rate_m_s2);
  attitude.read("max_yaw_rate_rad_s", config.attitude.max_yaw_rate_rad_s);
  attitude.finish();
  section.finish();
  flight::validate(config.rc);
  flight::validate(config.attitude);
}

void read_safety(YamlSection section, FlightConfig& config) {
  need(section, "switch_channel");
  flight::SafetyOptions& safety = config.loop.safety;
  section.read("switch_channel", config.loop.switch_channel);
  section.read("switch_on_min_us", safety.switch_on_min_us);
  section.read("switch_off_max_us", safety.switch_off_max_us);
  section.read("switch_hold_s", safety.switch_hold_s);
  section.read("heartbeat_timeout_s", safety.heartbeat_timeout_s);
  section.read("rc_timeout_s", safety.rc_timeout_s);
  section.read("camera_timeout_s", safety.camera_timeout_s);
  section.read("command_timeout_s", safety.command_timeout_s);
  section.read("max_tick_s", safety.max_tick_s);
  section.read("release_duration_s", safety.release_duration_s);
  section.read("release_repeats", safety.release_repeats);
  // LOITER: the paper's mode; and the guided modes are the only ones that heed attitude targets.
  std::vector<std::string> modes = config.output == flight::OutputKind::kAttitude
                                       ? std::vector<std::string>{"GUIDED", "GUIDED_NOGPS"}
                                       : std::vector<std::string>{"LOITER"};
  section.read("allowed_modes", modes);
  for (const auto& mode : modes) {
    config.loop.allowed_modes.push_back(flight::copter_mode(mode));
  }
  section.finish();
}

void read_task(YamlSection section, FlightConfig& config) {
  skills::SkillOptions& skill = config.skill;
  int kind = static_cast<int>(skill.task);
  section.read_choice("kind", {"dodge", "navigate", "gap"}, kind);
  skill.task = static_cast<skills::Task>(kind);
  section.read("max_interval_s", skill.max_interval_s);
  config.timed_rate = !section.has("planning_rate_hz");
  section.read("planning_rate_hz", skill.planning_rate_hz);
  config.timed_latency = !section.has("latency_s");
  section.read("latency_s", skill.latency_s);
  section.read("horizontal_fov_rad", skill.horizontal_fov_rad);
  section.read("camera_pitch_rad", config.loop.camera_pitch_rad);
  section.read("use_attitude", config.loop.use_attitude);
  YamlSection dodge = section.section("dodge");
  dodge.read("speed_m_s", skill.dodge_policy.speed_m_s);
  dodge.read("hold_s", skill.dodge_policy.hold_s);
  dodge.read("burst_m_s2", skill.dodge_policy.burst_m_s2);
  dodge.read("longest_s", skill.dodge_policy.longest_s);
  dodge.read("settle_s", skill.dodge_policy.settle_s);
  dodge.read("max_down_m_s", skill.dodge_policy.max_down_m_s);
  dodge.read("min_contrast", skill.dodge.min_contrast);
  dodge.read("min_uncertainty", skill.dodge.min_uncertainty);
  dodge.read("confirm_frames", skill.dodge.confirm_frames);
  dodge.read("confirm_s", skill.dodge.confirm_s);
  dodge.read("pair_s", skill.dodge_pair_s);
  dodge.read("use_background", skill.dodge.background.use);
  dodge.read("min_rise", skill.dodge.background.min_rise);
  dodge.finish();
  YamlSection navigate = section.section("navigate");
  navigate.read("speed_m_s", skill.navigate_policy.speed_m_s);
  navigate.read("slow_down", skill.navigate_policy.slow_down);
  navigate.read("max_acceleration_m_s2", skill.navigate_policy.max_acceleration_m_s2);
  navigate.read("max_forward_m_s2", skill.navigate_policy.max_forward_m_s2);
  navigate.read("speed_up_s", skill.navigate_policy.speed_up_s);
  navigate.read("weave", skill.navigate_policy.weave);
  navigate.read("weave_hz", skill.navigate_policy.weave_hz);
  navigate.read("goal_bearing_rad", skill.goal_bearing_rad);
  navigate.read("baseline_s", skill.baseline_s);
  navigate.read("baseline_m", skill.baseline_m);
  navigate.read("longest_baseline_s", skill.longest_baseline_s);
  navigate.read("baseline_share", skill.baseline_share);
  navigate.read("shortest_baseline_s", skill.shortest_baseline_s);
  navigate.read("camera_ahead_m", skill.corridor.camera_ahead_m);
  navigate.read("floor", skill.navigate.floor);
  navigate.read("blocked", skill.navigate.blocked);
  YamlSection horizon = navigate.section("horizon");
  horizon.read("floor", skill.horizon.floor);
  horizon.read("per_px", skill.horizon.per_px);
  horizon.read("least_shift_px", skill.horizon.least_shift_px);
  horizon.read("saturated", skill.horizon.saturated);
  horizon.finish();
  navigate.finish();
  YamlSection gap = section.section("gap");
  gap.read("forward_m_s", skill.gap_policy.forward_m_s);
  gap.read("coast_m_s", skill.gap_policy.coast_m_s);
  gap.read("coast_duration_s", skill.gap_policy.coast_duration_s);
  gap.read("aligned", skill.gap_policy.aligned);
  gap.read("realign", skill.gap_policy.realign);
  int explore = static_cast<int>(skill.explore.kind);
  gap.read_choice("explore", {"diagonal", "excited_hover"}, explore);
  skill.explore.kind = static_cast<control::ExploreKind>(explore);
  gap.read("explore_speed_m_s", skill.explore.speed_m_s);
  gap.read("first_look_s", skill.first_look_s);
  gap.read("last_look_s", skill.last_look_s);
  gap.read("settle_s", skill.settle_s);
  gap.read("rest_m_s", skill.rest_m_s);
  gap.read("rest_rad", skill.rest_rad);
  gap.read("slew_m_s2", skill.slew_m_s2);
  gap.finish();
  section.finish();
  skills::validate(skill);
}

void read_log(YamlSection section, FlightConfig& config) {
  section.read("folder", config.log.folder);
  section.read("frame_every", config.log.frame_every);
  double max_mib = static_cast<double>(config.log.max_bytes) / (1 << 20);
  section.read("max_mib", max_mib);
  if (config.log.frame_every < 0) {
    section.refuse("frame_every", "give 0 (no frames) or more");
  }
  if (!(max_mib >= 1.0 && max_mib <= 1e6)) {
    section.refuse("max_mib", "give 1 to 1000000");
  }
  config.log.max_bytes = static_cast<std::int64_t>(max_mib * (1 << 20));
  section.finish();
}

void read_threads(YamlSection section, FlightConfig& config) {
  section.read("perception_cpus", config.loop.perception_cpus);
  section.read("control_cpus", config.loop.control_cpus);
  section.read("tick_s", config.loop.tick_s);
  section.read("command_every_s", config.loop.command_every_s);
  section.finish();
}

void read_simulation(YamlSection section, FlightConfig& config) {
  section.read("time_scale", config.time_scale);
  if (!(config.time_scale >= 0.01 && config.time_scale <= 1.0)) {
    section.refuse("time_scale", "give 0.01 to 1");
  }
  // A vehicle does not slow down with the clock: every time-out would come late.
  if (config.time_scale != 1.0 && config.endpoint.host != "127.0.0.1") {
    section.refuse("time_scale",
                   "a slower clock is for simulations on this computer: the endpoint must be udpout:, udpin: "
                   "or tcp: at 127.0.0.1");
  }
  section.finish();
}

}  // namespace

FlightConfig parse_config(const std::string& text, const std::string& name) {
  return with_file(name, [&] {
    FlightConfig config;
    // Bounded, whatever the machine: more threads than a small computer has only make the network slower.
    config.engine.threads = 2;
    YamlSection root = YamlSection::parse(text, name);
    read_model(root.section("model"), config);
    read_source(root.section("source"), config);
    read_mavlink(root.section("mavlink"), config);
    read_output(root.section("output"), config);
    read_safety(root.section("safety"), config);
    read_task(root.section("task"), config);
    read_log(root.section("log"), config);
    read_threads(root.section("threads"), config);
    read_simulation(root.section("simulation"), config);
    root.finish();
    flight::validate(config.loop);
    if (config.output == flight::OutputKind::kRcOverride &&
        flight::make_rc_output(config.rc)->uses_channel(config.loop.switch_channel)) {
      throw_invalid("safety.switch_channel " + std::to_string(config.loop.switch_channel) +
                    " is overridden by an axis of output.rc: the pilot's switch must stay the pilot's");
    }
    return config;
  });
}

FlightConfig load_config(const std::string& path) {
  std::error_code error;
  if (!std::filesystem::exists(path, error)) {
    throw_not_found(path, "give the path of a configuration file");
  }
  std::ifstream stream(path, std::ios::binary);
  const std::string text((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  if (!stream.good() && !stream.eof()) {
    throw_invalid("configuration '" + path + "' cannot be read: give a file");
  }
  return parse_config(text, path);
}

flight::SigningKey load_signing_key(const std::string& path) {
  std::ifstream stream(path);
  std::string text;
  if (!(stream >> text)) {
    throw_not_found(path, "give a file with the 64 hexadecimal digits of the signing key");
  }
  flight::SigningKey key;
  if (text.size() != 2 * key.secret.size() || text.find_first_not_of("0123456789abcdefABCDEF") != std::string::npos) {
    throw_invalid("signing key file '" + path + "' does not hold 64 hexadecimal digits: write the key so");
  }
  for (std::size_t i = 0; i < key.secret.size(); ++i) {
    key.secret[i] = static_cast<std::uint8_t>(std::stoi(text.substr(2 * i, 2), nullptr, 16));
  }
  // The one use of the wall clock: signed messages are dated. Read once; afterwards each message counts on by itself.
  constexpr std::int64_t kEpoch2015_s = 1420070400;
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  const auto units = std::chrono::duration_cast<std::chrono::microseconds>(now).count() / 10;
  key.timestamp_10us = static_cast<std::uint64_t>(units - kEpoch2015_s * 100000);
  return key;
}

}  // namespace ajna::apps
