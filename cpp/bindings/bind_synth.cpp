// SPDX-License-Identifier: MIT
#include "ajna/synth/pair_generator.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using synth::PairBatch;
using synth::PairGenerator;
using synth::SceneConfig;

void bind_synth(py::module_& m) {
  py::class_<SceneConfig> config(m, "SceneConfig", "What the synthetic scenes look like.");
  config.def(py::init<>());
#define AJNA_FIELD(name) config.def_readwrite(#name, &SceneConfig::name)
  AJNA_FIELD(layers);
  AJNA_FIELD(layer_probability);
  AJNA_FIELD(min_size);
  AJNA_FIELD(max_size);
  AJNA_FIELD(blob_weight);
  AJNA_FIELD(polygon_weight);
  AJNA_FIELD(bar_weight);
  AJNA_FIELD(plate_weight);
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
  AJNA_FIELD(blur_probability);
  AJNA_FIELD(shutter);
  AJNA_FIELD(defocus_probability);
  AJNA_FIELD(defocus_max_px);
  AJNA_FIELD(noise_max);
  AJNA_FIELD(brightness_change);
  AJNA_FIELD(color_change);
  AJNA_FIELD(gamma_change);
  AJNA_FIELD(bank_size);
  AJNA_FIELD(texture_size);
  AJNA_FIELD(photo_probability);
  AJNA_FIELD(motion_boundary_px);
#undef AJNA_FIELD
  m.def("validate_scene_config", &synth::validate, "config"_a, "Raise ValueError naming the first field out of range.");

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
      .def("generate", &PairGenerator::generate, "batch"_a, "height"_a, "width"_a, "seed"_a, "flow_scale"_a = 1.0,
           py::call_guard<py::gil_scoped_release>())
      .def_property_readonly("config", &PairGenerator::config)
      .def_property_readonly(
          "textures", [](const PairGenerator& self) { return self.bank().textures(); },
          "float32 [N, 3, S, S] in [0, 1]");
}

}  // namespace ajna::bindings
