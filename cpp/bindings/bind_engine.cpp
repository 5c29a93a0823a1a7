// SPDX-License-Identifier: MIT
#include <pybind11/numpy.h>
#include <pybind11/stl/filesystem.h>

#include <memory>

#include "ajna/base/error.hpp"
#include "ajna/engine/flow_engine.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using engine::EngineOptions;
using engine::FlowEngine;
using engine::FramePair;
using engine::ModelInfo;

namespace {

using Frame = py::array_t<std::uint8_t, 0>;  // no forcecast flag: other dtypes are refused, not converted

/// A view of an [H, W, C] uint8 array whose pixels are packed; rows may be apart.
ImageView view_of(const py::array& array, const char* name) {
  if (!py::isinstance<Frame>(array) || array.ndim() != 3 || array.strides(2) != 1 ||
      array.strides(1) != array.shape(2)) {
    throw_invalid(std::string(name) + ": give a uint8 array [H, W, 3] with packed pixels");
  }
  // The engine counts in int; a side beyond it is refused there as too large.
  constexpr py::ssize_t kLargest = std::numeric_limits<int>::max();
  return {static_cast<const std::uint8_t*>(array.data()), static_cast<int>(std::min(array.shape(1), kLargest)),
          static_cast<int>(std::min(array.shape(0), kLargest)), static_cast<int>(std::min(array.shape(2), kLargest)),
          array.strides(0)};
}

/// [H, W, 2] over the vector's own memory, which the array then owns.
py::array_t<float> to_numpy(std::vector<float>&& values, int height, int width) {
  auto owner = std::make_unique<std::vector<float>>(std::move(values));
  float* data = owner->data();
  const py::capsule capsule(owner.get(), [](void* pointer) { delete static_cast<std::vector<float>*>(pointer); });
  owner.release();  // only now: the capsule's constructor may throw
  return py::array_t<float>({py::ssize_t{height}, py::ssize_t{width}, py::ssize_t{2}}, data, capsule);
}

py::tuple to_tuple(FlowField&& field) {
  return py::make_tuple(to_numpy(std::move(field.flow), field.height, field.width),
                        to_numpy(std::move(field.uncertainty), field.height, field.width),
                        to_numpy(std::move(field.expected_error), field.height, field.width), field.timestamp_s,
                        std::const_pointer_cast<ConformalFactors>(field.conformal));
}

}  // namespace

void bind_engine(py::module_& m) {
  py::class_<EngineOptions>(m, "EngineOptions", "How a model runs.")
      .def(py::init<>())
      .def_readwrite("device", &EngineOptions::device, "'cpu', 'cuda' or 'cuda:<index>'")
      .def_readwrite("threads", &EngineOptions::threads, "torch threads of the whole process; 0: leave as it is")
      .def_readwrite("bfloat16", &EngineOptions::bfloat16)
      .def_readwrite("max_pixels", &EngineOptions::max_pixels, "largest batch x height x width accepted");

  py::class_<ModelInfo>(m, "ModelInfo", "What a loaded model is and where it comes from.")
      .def_readonly("name", &ModelInfo::name)
      .def_readonly("path", &ModelInfo::path)
      .def_readonly("format", &ModelInfo::format, "'checkpoint' or 'torchscript'")
      .def_readonly("device", &ModelInfo::device)
      .def_readonly("precision", &ModelInfo::precision)
      .def_readonly("loss", &ModelInfo::loss)
      .def_readonly("flow_scale", &ModelInfo::flow_scale, "network output x flow_scale = pixels")
      .def_readonly("parameters", &ModelInfo::parameters)
      .def_readonly("stride", &ModelInfo::stride)
      .def_readonly("network", &ModelInfo::network)
      .def_readonly("provenance", &ModelInfo::provenance)
      .def_readonly("calibrated", &ModelInfo::calibrated, "fitted on held-out data: expected errors, intervals")
      .def_readonly("interval_levels", &ModelInfo::interval_levels, "calibrated shares of FlowField.interval")
      .def_readonly("calibration", &ModelInfo::calibration, "data, images, pixels, date ... of the calibration")
      .def("__repr__", [](const ModelInfo& self) {
        return "ModelInfo(name='" + self.name + "', format='" + self.format + "', device='" + self.device +
               "', parameters=" + std::to_string(self.parameters) + ")";
      });

  py::class_<FlowEngine>(m, "FlowEngine", "The C++ engine behind ajna.Model; use that one.")
      .def(py::init([](const std::filesystem::path& path, const EngineOptions& options) {
             return FlowEngine::load(path.string(), options);
           }),
           "path"_a, "options"_a = EngineOptions{}, py::call_guard<py::gil_scoped_release>())
      .def(
          "infer",
          [](const FlowEngine& self, const py::array& frame1, const py::array& frame2, double timestamp_s) {
            const ImageView view1 = view_of(frame1, "frame 1"), view2 = view_of(frame2, "frame 2");
            FlowField field;
            {
              const py::gil_scoped_release release;
              field = self.infer(view1, view2, timestamp_s);
            }
            return to_tuple(std::move(field));
          },
          "frame1"_a, "frame2"_a, "timestamp_s"_a = 0.0,
          "Two uint8 [H, W, 3] RGB arrays -> (flow, uncertainty, expected_error, timestamp_s, conformal), maps [H, W, "
          "2] "
          "float32; conformal is None where the model is not calibrated.")
      .def(
          "infer_batch",
          [](const FlowEngine& self, const std::vector<py::array>& frames1, const std::vector<py::array>& frames2,
             const std::vector<double>& timestamps_s) {
            if (frames1.size() != frames2.size() || frames1.size() != timestamps_s.size()) {
              throw_invalid("a batch of " + std::to_string(frames1.size()) + " first frames, " +
                            std::to_string(frames2.size()) + " second frames and " +
                            std::to_string(timestamps_s.size()) + " time stamps: give as many of each");
            }
            std::vector<FramePair> pairs;
            for (std::size_t i = 0; i < frames1.size(); ++i) {
              pairs.push_back({view_of(frames1[i], "frame 1"), view_of(frames2[i], "frame 2"), timestamps_s[i]});
            }
            std::vector<FlowField> fields;
            {
              const py::gil_scoped_release release;
              fields = self.infer_batch(pairs);
            }
            py::list results;
            for (auto& field : fields) {
              results.append(to_tuple(std::move(field)));
            }
            return results;
          },
          "frames1"_a, "frames2"_a, "timestamps_s"_a)
      .def("warm_up", &FlowEngine::warm_up, "width"_a, "height"_a, "batch"_a = 1, "runs"_a = 2,
           py::call_guard<py::gil_scoped_release>(), "Run on black frames: the first runs at a size are slow.")
      .def_property_readonly("info", &FlowEngine::info, py::return_value_policy::reference_internal);
}

}  // namespace ajna::bindings
