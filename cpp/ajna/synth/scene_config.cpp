// SPDX-License-Identifier: MIT
#include "ajna/synth/scene_config.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <string>
#include <vector>

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

void require_name(const char* field, const std::string& value, const std::vector<std::string>& known) {
  if (std::find(known.begin(), known.end(), value) == known.end()) {
    throw_unknown(field, value, known);
  }
}

void validate_camera(const SceneConfig& c) {
  require_name("camera", c.camera, {"off", "forward", "sideways", "fixate", "any"});
  require_name("surface", c.surface, {"wall", "floor", "table"});
  require_range("depth_near", c.depth_near, 0.01, 1);
  require_range("depth_far", c.depth_far, c.depth_near, 1);
  require_range("focal_min", c.focal_min, 0.5, 10);
  require_range("focal_max", c.focal_max, c.focal_min, 10);
  require_range("camera_rotation", c.camera_rotation, 0, 10);
  require_range("camera_height", c.camera_height, 0.01, 1);
  require_range("table_tilt_deg", c.table_tilt_deg, 0, 60);
  require_range("plane_tilt", c.plane_tilt, 0, 0.3);
  require_range("independent_probability", c.independent_probability, 0, 1);
  require_range("aligned_probability", c.aligned_probability, 0, 1);
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
  require_range("trunk_weight", c.trunk_weight, 0, 1e6);
  require(c.blob_weight + c.polygon_weight + c.bar_weight + c.plate_weight + c.trunk_weight > 0, "blob_weight",
          c.blob_weight, "give at least one shape weight above 0");
  require_range("plate_frame_probability", c.plate_frame_probability, 0, 1);
  require_range("hole_union_probability", c.hole_union_probability, 0, 1);
  require_range("placement_spread", c.placement_spread, 0, 2);
  require_name("flow_distribution", c.flow_distribution, {"exponential", "uniform", "log_uniform"});
  require_range("flow_mean_px", c.flow_mean_px, 0, 1e4);
  require_range("flow_max_px", c.flow_max_px, 0, 1e4);
  require_range("background_ratio", c.background_ratio, 0, 10);
  require_range("rotation_zoom", c.rotation_zoom, 0, 2);
  require_range("perspective_probability", c.perspective_probability, 0, 1);
  require_range("nonrigid_probability", c.nonrigid_probability, 0, 1);
  require_range("attached_probability", c.attached_probability, 0, 1);
  require_range("parallax_probability", c.parallax_probability, 0, 1);
  require_range("static_probability", c.static_probability, 0, 1);
  validate_camera(c);
  require_range("blur_probability", c.blur_probability, 0, 1);
  require_range("shutter", c.shutter, 0, 1);
  require_range("defocus_probability", c.defocus_probability, 0, 1);
  require_range("defocus_max_px", c.defocus_max_px, 0, 3);
  require_range("noise_max", c.noise_max, 0, 128);
  require_range("brightness_change", c.brightness_change, 0, 0.9);
  require_range("color_change", c.color_change, 0, 0.9);
  require_range("gamma_change", c.gamma_change, 0, 0.9);
  require_range("blink_probability", c.blink_probability, 0, 1);
  require_range("light_probability", c.light_probability, 0, 1);
  require_range("jump_probability", c.jump_probability, 0, 1);
  require_range("jump_stops", c.jump_stops, 0, 4);
  require_range("bank_size", static_cast<double>(c.bank_size), 1, 65536);
  require_range("texture_size", static_cast<double>(c.texture_size), 16, 2048);
  require_range("flat_texture_share", c.flat_texture_share, 0, 1);
  require_range("repetitive_texture_share", c.repetitive_texture_share, 0, 1 - c.flat_texture_share);
  require_range("photo_probability", c.photo_probability, 0, 1);
  require_range("motion_boundary_px", c.motion_boundary_px, 0, 1e4);
}

}  // namespace ajna::synth
