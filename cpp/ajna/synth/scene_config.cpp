// SPDX-License-Identifier: MIT
#include "ajna/synth/scene_config.hpp"

#include <cmath>
#include <sstream>

#include "ajna/base/error.hpp"

namespace ajna::synth {
namespace {

void require(bool ok, const char* field, double value, const char* remedy) {
  if (!ok) {
    std::ostringstream text;
    text << "scene option " << field << " = " << value << ": " << remedy;
    throw_invalid(text.str());
  }
}

void require_range(const char* field, double value, double low, double high) {
  std::ostringstream remedy;
  remedy << "give a number from " << low << " to " << high;
  require(std::isfinite(value) && value >= low && value <= high, field, value, remedy.str().c_str());
}

}  // namespace

void validate(const SceneConfig& c) {
  require_range("layers", static_cast<double>(c.layers), 0, 32);
  require_range("layer_probability", c.layer_probability, 0, 1);
  require_range("min_size", c.min_size, 0.005, 2);
  require_range("max_size", c.max_size, c.min_size, 4);
  require_range("blob_weight", c.blob_weight, 0, 1e6);
  require_range("polygon_weight", c.polygon_weight, 0, 1e6);
  require_range("bar_weight", c.bar_weight, 0, 1e6);
  require_range("plate_weight", c.plate_weight, 0, 1e6);
  require(c.blob_weight + c.polygon_weight + c.bar_weight + c.plate_weight > 0, "blob_weight", c.blob_weight,
          "give at least one shape weight above 0");
  if (c.flow_distribution != "exponential" && c.flow_distribution != "uniform" &&
      c.flow_distribution != "log_uniform") {
    throw_unknown("flow_distribution", c.flow_distribution, {"exponential", "uniform", "log_uniform"});
  }
  require_range("flow_mean_px", c.flow_mean_px, 0, 1e4);
  require_range("flow_max_px", c.flow_max_px, 0, 1e4);
  require_range("background_ratio", c.background_ratio, 0, 10);
  require_range("rotation_zoom", c.rotation_zoom, 0, 2);
  require_range("perspective_probability", c.perspective_probability, 0, 1);
  require_range("nonrigid_probability", c.nonrigid_probability, 0, 1);
  require_range("attached_probability", c.attached_probability, 0, 1);
  require_range("parallax_probability", c.parallax_probability, 0, 1);
  require_range("static_probability", c.static_probability, 0, 1);
  require_range("blur_probability", c.blur_probability, 0, 1);
  require_range("shutter", c.shutter, 0, 1);
  require_range("defocus_probability", c.defocus_probability, 0, 1);
  require_range("defocus_max_px", c.defocus_max_px, 0, 3);
  require_range("noise_max", c.noise_max, 0, 128);
  require_range("brightness_change", c.brightness_change, 0, 0.9);
  require_range("color_change", c.color_change, 0, 0.9);
  require_range("gamma_change", c.gamma_change, 0, 0.9);
  require_range("bank_size", static_cast<double>(c.bank_size), 1, 65536);
  require_range("texture_size", static_cast<double>(c.texture_size), 16, 2048);
  require_range("photo_probability", c.photo_probability, 0, 1);
  require_range("motion_boundary_px", c.motion_boundary_px, 0, 1e4);
}

}  // namespace ajna::synth
