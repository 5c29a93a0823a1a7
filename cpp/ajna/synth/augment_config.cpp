// SPDX-License-Identifier: MIT
#include "ajna/synth/augment_config.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "ajna/base/error.hpp"

namespace ajna::synth {
namespace {

void require_range(const char* field, double value, double low, double high) {
  if (!std::isfinite(value) || value < low || value > high) {
    std::ostringstream text;
    text << "augmentation option " << field << " = " << value << ": give a number from " << low << " to " << high;
    throw_invalid(text.str());
  }
}

AugmentConfig none() {
  AugmentConfig c;
  c.color_probability = c.asymmetric_probability = c.blur_probability = c.spatial_probability = 0;
  c.flip_x_probability = c.flip_y_probability = c.relative_probability = c.patch_probability = 0;
  return c;
}

AugmentConfig authors() {
  auto c = none();
  c.color_probability = 1;
  c.asymmetric_probability = 1;
  c.brightness = 20.0 / 255.0;
  c.contrast = 0.5;
  c.hue = 0.5;
  c.saturation = 0.5;
  c.gamma = 0.1;
  c.noise = 20.0 / 255.0;
  return c;
}

}  // namespace

const std::vector<AugmentPreset>& augment_presets() {
  static const std::vector<AugmentPreset> presets = {
      {"standard", "colour, scale, rotation, flips, small relative motion, patches and blur", AugmentConfig{}},
      {"authors", "the six photometric changes of the paper's authors, each frame on its own, and a crop", authors()},
      {"none", "a crop at a random place", none()},
  };
  return presets;
}

const AugmentPreset& augment_preset(const std::string& name) {
  const auto& presets = augment_presets();
  const auto found = std::find_if(presets.begin(), presets.end(), [&](const auto& p) { return p.name == name; });
  if (found == presets.end()) {
    std::vector<std::string> names;
    names.reserve(presets.size());
    for (const auto& preset : presets) {
      names.push_back(preset.name);
    }
    throw_unknown("augmentation preset", name, names);
  }
  return *found;
}

void validate(const AugmentConfig& c) {
  require_range("brightness", c.brightness, 0, 1);
  require_range("contrast", c.contrast, 0, 1);
  require_range("hue", c.hue, 0, 0.5);
  require_range("saturation", c.saturation, 0, 1);
  require_range("gamma", c.gamma, 0, 0.9);
  require_range("noise", c.noise, 0, 1);
  require_range("color_probability", c.color_probability, 0, 1);
  require_range("asymmetric_probability", c.asymmetric_probability, 0, 1);
  require_range("blur_probability", c.blur_probability, 0, 1);
  require_range("blur_max_px", c.blur_max_px, 0, 3);
  require_range("spatial_probability", c.spatial_probability, 0, 1);
  require_range("scale_min", c.scale_min, -3, 3);
  require_range("scale_max", c.scale_max, c.scale_min, 3);
  require_range("stretch_probability", c.stretch_probability, 0, 1);
  require_range("stretch", c.stretch, 0, 1);
  require_range("rotation_deg", c.rotation_deg, 0, 180);
  require_range("flip_x_probability", c.flip_x_probability, 0, 1);
  require_range("flip_y_probability", c.flip_y_probability, 0, 1);
  require_range("swap_probability", c.swap_probability, 0, 1);
  require_range("relative_probability", c.relative_probability, 0, 1);
  require_range("relative_translation", c.relative_translation, 0, 1);
  require_range("relative_rotation_deg", c.relative_rotation_deg, 0, 180);
  require_range("relative_scale", c.relative_scale, 0, 0.5);
  require_range("patch_probability", c.patch_probability, 0, 1);
  require_range("patch_count", static_cast<double>(c.patch_count), 1, 64);
  require_range("patch_min_size", c.patch_min_size, 0, 1);
  require_range("patch_max_size", c.patch_max_size, c.patch_min_size, 1);
}

}  // namespace ajna::synth
