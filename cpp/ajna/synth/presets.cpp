// SPDX-License-Identifier: MIT
#include "ajna/synth/presets.hpp"

#include <algorithm>

#include "ajna/base/error.hpp"

namespace ajna::synth {
namespace {

// Figures with a source carry it; all others are chosen. "Paper" is the one that the network is from (Science Robotics
// 2023); M16 is Mayer et al., CVPR 2016 (FlyingThings3D); D15 is Dosovitskiy et al., ICCV 2015 (FlyingChairs), after
// which Ilg et al., ECCV 2018, made FlyingChairs2.

/// No layer rides with another one, and none bends.
SceneConfig rigid() {
  SceneConfig c;
  c.nonrigid_probability = 0;
  c.attached_probability = 0;
  c.parallax_probability = 0;
  return c;
}

SceneConfig in_depth() {
  auto c = rigid();
  c.background_ratio = 1;  // the drawn displacement is the camera's
  c.static_probability = 0.03;
  return c;
}

SceneConfig chairs() {
  auto c = rigid();
  c.layers = 12;
  c.layer_probability = 0.9;
  c.min_size = 0.08;
  c.max_size = 0.5;
  c.bar_weight = 0.6;  // legs and backs
  c.plate_weight = 0;
  c.perspective_probability = 0;  // affine motions (D15)
  c.background_ratio = 0.8;       // chairs move relative to a background that moves, too (D15)
  c.static_probability = 0;
  c.flow_mean_px = 6;  // D15 fits the histogram of displacements to Sintel's; an exponential is long-tailed like it
  c.flow_max_px = 80;
  c.blur_probability = 0;  // clean renderings
  c.defocus_probability = 0.2;
  c.noise_max = 2;
  c.brightness_change = c.color_change = c.gamma_change = 0;
  return c;
}

SceneConfig things() {
  auto c = in_depth();
  c.layers = 14;  // 5 to 20 objects a scene (M16): here 12.6 in the mean
  c.layer_probability = 0.9;
  c.min_size = 0.06;
  c.max_size = 0.4;
  c.plate_weight = 0.1;
  c.camera = "any";                  // objects and camera move on three-dimensional paths (M16)
  c.independent_probability = 0.75;  // the rest are the static background objects of M16
  c.perspective_probability = 1;
  c.rotation_zoom = 0.5;
  c.focal_min = c.focal_max = 35.0 / 32.0;  // 35 mm lens on a sensor 32 mm wide (M16)
  c.depth_near = 0.15;
  c.flow_mean_px = 8;
  c.flow_max_px = 60;
  c.blur_probability = 0.5;  // the "final" pass has motion blur and defocus, the "clean" pass has not (M16)
  c.defocus_probability = 0.5;
  c.noise_max = 2;
  c.brightness_change = c.color_change = c.gamma_change = 0;
  return c;
}

SceneConfig dodge() {
  auto c = rigid();
  c.layers = 3;
  c.layer_probability = 0.75;
  c.min_size = 0.03;  // a ball of 140 mm (Paper) at 2.5 m with f = 0.8 widths: radius 3 % of the height of a 4:3 image
  c.max_size = 0.18;  // a quadrotor of 440 mm (Paper) 1.5 m before the camera: 16 %
  c.bar_weight = 0.4;
  c.plate_weight = 0;
  c.placement_spread = 0.45;  // in view
  c.flow_distribution = "uniform";
  c.flow_max_px = 24;
  c.background_ratio = 0.04;
  c.static_probability = 0.3;
  c.rotation_zoom = 0.5;  // it comes nearer and tumbles
  c.perspective_probability = 0.2;
  c.blur_probability = 0.5;
  return c;
}

SceneConfig navigate() {
  auto c = in_depth();
  c.camera = "forward";
  c.surface = "floor";
  c.layers = 14;
  c.layer_probability = 0.85;
  c.blob_weight = 0.15;  // bushes
  c.polygon_weight = c.bar_weight = c.plate_weight = 0;
  c.trunk_weight = 1;
  c.min_size = 0.2;  // trunks of 0.6 to 0.9 m in a scene 40 m deep (Paper), about a tenth of the layer's radius
  c.max_size = 0.5;
  c.depth_near = 0.08;  // 3 m of 40 m
  c.depth_far = 0.85;
  c.camera_height = 0.045;  // 1.8 m of 40 m
  c.plane_tilt = 0;
  c.camera_rotation = 0.3;
  c.flow_mean_px = 2;  // at 4.8 m/s and 30 Hz (Paper) something at 10 m moves by 1 px, at 3 m by 4 px in 320x240
  c.flow_max_px = 12;
  return c;
}

SceneConfig gap() {
  auto c = in_depth();
  c.camera = "sideways";
  c.layers = 1;
  c.layer_probability = 1;
  c.blob_weight = c.polygon_weight = c.bar_weight = 0;
  c.plate_weight = 1;
  c.plate_frame_probability = 0.1;
  c.hole_union_probability = 0.4;
  c.min_size = 0.2;
  c.max_size = 0.45;
  c.placement_spread = 0.25;
  c.depth_near = 0.25;  // 3.0 m before a wall at 7.2 m (Paper): 0.42
  c.depth_far = 0.65;
  c.flow_distribution = "uniform";
  c.flow_max_px = 12;
  return c;
}

SceneConfig pile() {
  auto c = in_depth();
  c.camera = "fixate";
  c.surface = "table";
  c.layers = 14;
  c.layer_probability = 0.85;
  c.bar_weight = 0.3;
  c.plate_weight = 0;
  c.min_size = 0.08;
  c.max_size = 0.24;
  c.placement_spread = 0.3;
  c.depth_near = 0.78;
  c.depth_far = 0.97;
  c.camera_rotation = 0.05;
  c.flow_distribution = "uniform";
  c.flow_max_px = 40;  // before the camera turns back to the pile
  return c;
}

SceneConfig photometric() {
  SceneConfig c;
  c.static_probability = 0.35;
  c.flow_mean_px = 2.5;
  c.flat_texture_share = 0.4;
  c.repetitive_texture_share = 0.35;
  c.photo_probability = 0;
  c.blink_probability = 0.3;
  c.light_probability = 0.4;
  c.jump_probability = 0.4;
  c.brightness_change = 0.25;
  c.gamma_change = 0.25;
  return c;
}

}  // namespace

const std::vector<ScenePreset>& scene_presets() {
  static const std::vector<ScenePreset> presets = {
      {"general", "layers of all shapes that move each on their own, or along the background", SceneConfig{}},
      {"chairs", "many objects in affine motion over a moving background, after FlyingChairs2", chairs()},
      {"things", "objects and camera on paths in depth, after FlyingThings3D", things()},
      {"dodge", "fast small objects before a nearly static background", dodge()},
      {"navigate", "a forest of thin trunks on a floor, seen in forward flight with true parallax", navigate()},
      {"gap", "a plate with a hole of any shape before a far wall, seen in sideways flight with true parallax", gap()},
      {"pile", "many overlapping objects on a table, seen from two views", pile()},
      {"photometric", "flat and repetitive textures, blinking lights and exposure jumps, often without motion",
       photometric()},
  };
  return presets;
}

const ScenePreset& scene_preset(const std::string& name) {
  const auto& presets = scene_presets();
  const auto found = std::find_if(presets.begin(), presets.end(), [&](const auto& p) { return p.name == name; });
  if (found == presets.end()) {
    std::vector<std::string> names;
    names.reserve(presets.size());
    for (const auto& preset : presets) {
      names.push_back(preset.name);
    }
    throw_unknown("scene preset", name, names);
  }
  return *found;
}

}  // namespace ajna::synth
