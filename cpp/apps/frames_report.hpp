// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <string>

#include "ajna/engine/flow_engine.hpp"

namespace ajna::apps {

struct FramesOptions {
  std::string model;
  std::string frames;
  engine::EngineOptions engine;
  std::string size;             ///< "WxH" or empty
  std::int64_t max_frames = 0;  ///< 0: all
};

/// Every pair of a folder's frames through the engine: one line of JSON each on stdout. No clock, no autopilot.
/// Throws Error.
void report_frames(const FramesOptions& options);

}  // namespace ajna::apps
