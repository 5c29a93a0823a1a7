// SPDX-License-Identifier: MIT
#include <algorithm>
#include <array>
#include <map>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/synth/augment.hpp"
#include "ajna/synth/pair_generator.hpp"
#include "ajna/synth/presets.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using synth::AugmentConfig;
using synth::Augmenter;
using synth::AugmentPreset;
using synth::LabelledPairs;
using synth::PairBatch;
using synth::PairGenerator;
using synth::SceneConfig;
using synth::ScenePreset;

namespace {

/// The tensors of an augmentation batch by name.
constexpr std::array<std::pair<const char*, torch::Tensor LabelledPairs::*>, 10> kPairTensors = {{
    {"frame1", &LabelledPairs::frame1},
    {"frame2", &LabelledPairs::frame2},
    {"flow", &LabelledPairs::flow},
    {"flow_backward", &LabelledPairs::flow_backward},
    {"valid", &LabelledPairs::valid},
    {"valid_backward", &LabelledPairs::valid_backward},
    {"occlusion", &LabelledPairs::occlusion},
    {"occlusion_backward", &LabelledPairs::occlusion_backward},
    {"motion_boundary", &LabelledPairs::motion_boundary},
    {"motion_boundary_backward", &LabelledPairs::motion_boundary_backward},
}};

std::map<std::string, torch::Tensor> augment(const Augmenter& self, const std::map<std::string, torch::Tensor>& batch,
                                             std::int64_t height, std::int64_t width, std::uint64_t seed) {
  LabelledPairs pairs;
  std::size_t known = 0;
  for (const auto& [name, member] : kPairTensors) {
    const auto found = batch.find(name);
    if (found != batch.end()) {
      pairs.*member = found->second;
      ++known;
    }
  }
  if (known != batch.size()) {
    std::vector<std::string> names;
    names.reserve(kPairTensors.size());
    for (const auto& [name, member] : kPairTensors) {
      names.emplace_back(name);
    }
    for (const auto& [name, tensor] : batch) {
      if (std::find(names.begin(), names.end(), name) == names.end()) {
        throw_unknown("tensor of a batch to augment", name, names);
      }
    }
  }
  const auto done = self.augment(pairs, height, width, seed);
  std::map<std::string, torch::Tensor> result;
  for (const auto& [name, member] : kPairTensors) {
    if ((done.*member).defined()) {
      result.emplace(name, done.*member);
    }
  }
  return result;
}

void bind_augment(py::module_& m) {
  py::class_<AugmentConfig> config(m, "AugmentConfig", "How frame pairs are augmented.");
  config.def(py::init<>()).def(py::init<const AugmentConfig&>(), "other"_a);
#define AJNA_FIELD(name) config.def_readwrite(#name, &AugmentConfig::name)
  AJNA_FIELD(brightness);
  AJNA_FIELD(contrast);
  AJNA_FIELD(hue);
  AJNA_FIELD(saturation);
  AJNA_FIELD(gamma);
  AJNA_FIELD(noise);
  AJNA_FIELD(color_probability);
  AJNA_FIELD(asymmetric_probability);
  AJNA_FIELD(blur_probability);
  AJNA_FIELD(blur_max_px);
  AJNA_FIELD(spatial_probability);
  AJNA_FIELD(scale_min);
  AJNA_FIELD(scale_max);
  AJNA_FIELD(stretch_probability);
  AJNA_FIELD(stretch);
  AJNA_FIELD(rotation_deg);
  AJNA_FIELD(flip_x_probability);
  AJNA_FIELD(flip_y_probability);
  AJNA_FIELD(swap_probability);
  AJNA_FIELD(relative_probability);
  AJNA_FIELD(relative_translation);
  AJNA_FIELD(relative_rotation_deg);
  AJNA_FIELD(relative_scale);
  AJNA_FIELD(patch_probability);
  AJNA_FIELD(patch_count);
  AJNA_FIELD(patch_min_size);
  AJNA_FIELD(patch_max_size);
#undef AJNA_FIELD

  py::class_<AugmentPreset>(m, "AugmentPreset", "Augmentation options by name.")
      .def_readonly("name", &AugmentPreset::name)
      .def_readonly("summary", &AugmentPreset::summary)
      .def_readonly("config", &AugmentPreset::config, py::return_value_policy::copy);
  m.def("augment_presets", &synth::augment_presets, "All augmentation presets; the first has the defaults.");
  m.def("augment_preset", &synth::augment_preset, "name"_a, "The augmentation preset of that name.");

  py::class_<Augmenter>(m, "Augmenter", "Random changes of colour and geometry of frame pairs with their ground truth.")
      .def(py::init<const AugmentConfig&>(), "config"_a = AugmentConfig{})
      .def("augment", &augment, "batch"_a, "height"_a, "width"_a, "seed"_a, py::call_guard<py::gil_scoped_release>(),
           "Augmented crops as a dict of tensors, with 'valid' always among them.")
      .def_property_readonly("config", &Augmenter::config, py::return_value_policy::copy);
}

}  // namespace

void bind_synth(py::module_& m) {
  bind_augment(m);
  py::class_<SceneConfig> config(m, "SceneConfig", "What the synthetic scenes look like.");
  config.def(py::init<>()).def(py::init<const SceneConfig&>(), "other"_a);
#define AJNA_FIELD(name) config.def_readwrite(#name, &SceneConfig::name)
  AJNA_FIELD(layers);
  AJNA_FIELD(layer_probability);
  AJNA_FIELD(min_size);
  AJNA_FIELD(max_size);
  AJNA_FIELD(blob_weight);
  AJNA_FIELD(polygon_weight);
  AJNA_FIELD(bar_weight);
  AJNA_FIELD(plate_weight);
  AJNA_FIELD(trunk_weight);
  AJNA_FIELD(plate_frame_probability);
  AJNA_FIELD(hole_union_probability);
  AJNA_FIELD(placement_spread);
  AJNA_FIELD(flow_distribution);
  AJNA_FIELD(flow_mean_px);
  AJNA_FIELD(flow_max_px);
  AJNA_FIELD(background_ratio);
  AJNA_FIELD(rotation_zoom);
  AJNA_FIELD(perspective_probability);
  AJNA_FIELD(nonrigid_probability);
  AJNA_FIELD(attached_probability);
  AJNA_FIELD(parallax_probability);
  AJNA_FIELD(static_probability);
  AJNA_FIELD(camera);
  AJNA_FIELD(surface);
  AJNA_FIELD(depth_near);
  AJNA_FIELD(depth_far);
  AJNA_FIELD(focal_min);
  AJNA_FIELD(focal_max);
  AJNA_FIELD(camera_rotation);
  AJNA_FIELD(camera_height);
  AJNA_FIELD(table_tilt_deg);
  AJNA_FIELD(plane_tilt);
  AJNA_FIELD(independent_probability);
  AJNA_FIELD(aligned_probability);
  AJNA_FIELD(blur_probability);
  AJNA_FIELD(shutter);
  AJNA_FIELD(defocus_probability);
  AJNA_FIELD(defocus_max_px);
  AJNA_FIELD(noise_max);
  AJNA_FIELD(brightness_change);
  AJNA_FIELD(color_change);
  AJNA_FIELD(gamma_change);
  AJNA_FIELD(blink_probability);
  AJNA_FIELD(light_probability);
  AJNA_FIELD(jump_probability);
  AJNA_FIELD(jump_stops);
  AJNA_FIELD(bank_size);
  AJNA_FIELD(texture_size);
  AJNA_FIELD(flat_texture_share);
  AJNA_FIELD(repetitive_texture_share);
  AJNA_FIELD(photo_probability);
  AJNA_FIELD(motion_boundary_px);
#undef AJNA_FIELD
  m.def("validate_scene_config", py::overload_cast<const SceneConfig&>(&synth::validate), "config"_a,
        "Raise ValueError naming the first field out of range.");

  py::class_<ScenePreset>(m, "ScenePreset", "Scene options that teach one thing, by name.")
      .def_readonly("name", &ScenePreset::name)
      .def_readonly("summary", &ScenePreset::summary)
      .def_readonly("config", &ScenePreset::config, py::return_value_policy::copy);
  m.def("scene_presets", &synth::scene_presets, "All scene presets; the first has the defaults.");
  m.def("scene_preset", &synth::scene_preset, "name"_a, "The scene preset of that name.");

  py::class_<PairBatch>(m, "PairBatch", "B synthetic frame pairs with exact ground truth on frame 1's grid.")
      .def_readonly("frame1", &PairBatch::frame1, "uint8 [B, 3, H, W] RGB")
      .def_readonly("frame2", &PairBatch::frame2, "uint8 [B, 3, H, W] RGB")
      .def_readonly("flow", &PairBatch::flow, "float32 [B, 2, H, W], pixels")
      .def_readonly("occlusion", &PairBatch::occlusion, "bool [B, 1, H, W]")
      .def_readonly("motion_boundary", &PairBatch::motion_boundary, "bool [B, 1, H, W]")
      .def_readonly("layer1", &PairBatch::layer1, "uint8 [B, 1, H, W]: front-most layer in frame 1")
      .def_readonly("layer2", &PairBatch::layer2, "uint8 [B, 1, H, W]: front-most layer in frame 2");

  py::class_<PairGenerator>(m, "PairGenerator", "Synthetic frame pairs with exact flow, occlusion and boundaries.")
      .def(py::init([](const SceneConfig& scene, std::uint64_t bank_seed, const std::string& device,
                       const std::optional<torch::Tensor>& photos) {
             const py::gil_scoped_release release;
             return std::make_unique<PairGenerator>(scene, bank_seed, torch::Device(device), photos);
           }),
           "config"_a = SceneConfig{}, "bank_seed"_a = 0, "device"_a = "cpu", "photos"_a = py::none())
      .def(py::init<const SceneConfig&, const PairGenerator&>(), "config"_a, "other"_a,
           "Scenes that share the textures and the device of another generator.")
      .def("generate", &PairGenerator::generate, "batch"_a, "height"_a, "width"_a, "seed"_a, "flow_scale"_a = 1.0,
           py::call_guard<py::gil_scoped_release>())
      .def_property_readonly("config", &PairGenerator::config, py::return_value_policy::copy)
      .def_property_readonly(
          "textures", [](const PairGenerator& self) { return self.bank().textures(); },
          "float32 [N, 3, S, S] in [0, 1]");
}

}  // namespace ajna::bindings
