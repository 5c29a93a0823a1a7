// SPDX-License-Identifier: MIT
#pragma once

#include <string>
#include <vector>

#include "ajna/synth/scene_config.hpp"

namespace ajna::synth {

/// Scene options that teach one thing, by name.
struct ScenePreset {
  std::string name;
  std::string summary;  ///< one sentence: what is seen
  SceneConfig config;
};

/// All presets; the first, "general", has the defaults of SceneConfig.
const std::vector<ScenePreset>& scene_presets();

/// Throws Error(kInvalidArgument) that suggests the nearest name.
const ScenePreset& scene_preset(const std::string& name);

}  // namespace ajna::synth
