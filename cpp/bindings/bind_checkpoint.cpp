// SPDX-License-Identifier: MIT
#include <pybind11/stl/filesystem.h>

#include "ajna/nn/checkpoint.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/torchscript.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using nn::FlowNetImpl;
using nn::Metadata;
using nn::UncertaintyTable;

void bind_checkpoint(py::module_& m) {
  py::class_<UncertaintyTable>(m, "UncertaintyTable",
                               "What raw uncertainty means, sampled from the loss: piecewise linear in raw.")
      .def(py::init([](double raw_min, double raw_step, torch::Tensor uncertainty, torch::Tensor expected_error) {
             UncertaintyTable table{raw_min, raw_step, std::move(uncertainty), std::move(expected_error)};
             table.check();
             return table;
           }),
           "raw_min"_a, "raw_step"_a, "uncertainty"_a, "expected_error"_a,
           "Both curves [K] float32, not decreasing; expected_error in training units (pixels / flow_scale).")
      .def_readonly("raw_min", &UncertaintyTable::raw_min)
      .def_readonly("raw_step", &UncertaintyTable::raw_step)
      .def_readonly("uncertainty", &UncertaintyTable::uncertainty)
      .def_readonly("expected_error", &UncertaintyTable::expected_error)
      .def(
          "evaluate",
          [](const UncertaintyTable& self, const torch::Tensor& raw) {
            const py::gil_scoped_release release;
            auto values = self.evaluate(raw);
            return std::make_pair(std::move(values.uncertainty), std::move(values.expected_error));
          },
          "raw"_a, "(uncertainty, expected_error) at raw, both of its shape; expected_error in training units.")
      .def(
          "to", [](const UncertaintyTable& self, const torch::Device& device) { return self.to(device); }, "device"_a);

  py::class_<Metadata>(m, "CheckpointMetadata", "What a checkpoint carries beside the weights.")
      .def(py::init<>())
      .def_readwrite("name", &Metadata::name)
      .def_readwrite("net", &Metadata::net)
      .def_readwrite("flow_scale", &Metadata::flow_scale)
      .def_readwrite("loss", &Metadata::loss)
      .def_readwrite("table", &Metadata::table)
      .def_readwrite("provenance", &Metadata::provenance)
      .def("to_strings", &nn::metadata_to_strings, "The flat strings that both file formats carry.");

  m.def("network_input", &nn::network_input, "frame1"_a, "frame2"_a, py::call_guard<py::gil_scoped_release>(),
        "Two uint8 (or float 0..255) [N, 3, H, W] RGB frames -> float32 [N, 6, H, W] in [-1, 1].");
  m.def(
      "save_checkpoint",
      [](const std::filesystem::path& path, const FlowNetImpl& net, const Metadata& metadata) {
        nn::save_checkpoint(path.string(), net, metadata);
      },
      "path"_a, "net"_a, "metadata"_a, py::call_guard<py::gil_scoped_release>(),
      "Write a .safetensors checkpoint atomically; `net` is a FlowNetCore.");
  m.def(
      "export_torchscript",
      [](const std::filesystem::path& path, const FlowNetImpl& net, const Metadata& metadata) {
        nn::export_torchscript(net, metadata, path.string());
      },
      "path"_a, "net"_a, "metadata"_a, py::call_guard<py::gil_scoped_release>(),
      "Write a frozen TorchScript file with methods forward and predict, verified and atomically.");
  m.def(
      "load_checkpoint",
      [](const std::filesystem::path& path) {
        nn::Checkpoint checkpoint;
        {
          const py::gil_scoped_release release;
          checkpoint = nn::load_checkpoint(path.string());
        }
        return std::make_pair(checkpoint.net.ptr(), std::move(checkpoint.metadata));
      },
      "path"_a, "(FlowNetCore in eval mode, CheckpointMetadata); strict, executes no code from the file.");
}

}  // namespace ajna::bindings
