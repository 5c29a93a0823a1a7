// SPDX-License-Identifier: MIT
#pragma once

#include <optional>
#include <string>

#include "ajna/engine/flow_engine.hpp"
#include "ajna/flight/command_output.hpp"
#include "ajna/flight/flight_log.hpp"
#include "ajna/flight/flight_loop.hpp"
#include "ajna/flight/link.hpp"
#include "ajna/flight/source.hpp"
#include "ajna/flight/transport.hpp"

namespace ajna::apps {

/// All that a flight is configured by; the defaults are those of the libraries' own structs.
struct FlightConfig {
  std::string model_path;
  engine::EngineOptions engine;
  flight::SourceOptions source;
  flight::Endpoint endpoint;
  std::string endpoint_text;
  flight::LinkOptions link;
  std::string signing_key_file;  ///< empty: messages are not signed
  flight::OutputKind output = flight::OutputKind::kRcOverride;
  flight::RcOutputOptions rc;
  flight::AttitudeOutputOptions attitude;
  skills::SkillOptions skill;
  bool timed_rate = true;     ///< skill.planning_rate_hz is not given: to be timed on this computer
  bool timed_latency = true;  ///< skill.latency_s is not given: to be timed on this computer
  flight::LoopOptions loop;
  flight::LogOptions log;
  double time_scale = 1.0;  ///< of the clock, below 1 for simulations that are slower than time
};

/// Read and validate the text of a configuration file; every key is optional but model.path, source.kind, source.path,
/// mavlink.endpoint and safety.switch_channel. Throws Error(kInvalidArgument) with the key, its line and the remedy.
FlightConfig parse_config(const std::string& text, const std::string& name);
/// The same from a file. Throws Error(kFileNotFound) as well.
FlightConfig load_config(const std::string& path);

/// The key in a file of 64 hexadecimal digits, with the present time. Throws Error.
flight::SigningKey load_signing_key(const std::string& path);

}  // namespace ajna::apps
