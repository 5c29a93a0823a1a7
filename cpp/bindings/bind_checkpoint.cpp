// SPDX-License-Identifier: MIT
#include <pybind11/stl/filesystem.h>

#include "ajna/nn/calibration.hpp"
#include "ajna/nn/checkpoint.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/torchscript.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using nn::Calibration;
using nn::ConformalFit;
using nn::ExpectedErrorFit;
using nn::FlowNetImpl;
using nn::Metadata;
using nn::UncertaintyTable;

namespace {

void bind_calibration(py::module_& m) {
  using Release = py::call_guard<py::gil_scoped_release>;
  py::class_<Calibration>(m, "Calibration", "What calibration adds to a checkpoint beside the table's new curve.")
      .def(py::init([](ConformalFactors factors, std::map<std::string, std::string> provenance) {
             Calibration calibration{std::move(factors), std::move(provenance)};
             calibration.check();
             return calibration;
           }),
           "factors"_a, "provenance"_a, "provenance says at least data, images, pixels and date.")
      .def_readonly("factors", &Calibration::factors)
      .def_readonly("provenance", &Calibration::provenance);

  py::class_<ExpectedErrorFit>(m, "ExpectedErrorFit", "Mean absolute error per axis as a monotone function of raw.")
      .def(py::init(
               [](const UncertaintyTable& table, double flow_scale, const std::string& weighting, double min_share) {
                 return ExpectedErrorFit(table, flow_scale, nn::parse_pixel_weighting(weighting), min_share);
               }),
           "table"_a, "flow_scale"_a, "weighting"_a = "image", "min_share"_a = nn::kMinGroupShare)
      .def("add", &ExpectedErrorFit::add, "raw"_a, "error"_a, "valid"_a, Release(),
           "One image: raw, error (px) [2, H, W], valid bool [H, W].")
      .def("table", &ExpectedErrorFit::table, "The table with the fitted curve.")
      .def_property_readonly("images", &ExpectedErrorFit::images)
      .def_property_readonly("pixels", &ExpectedErrorFit::pixels);

  py::class_<ConformalFit>(m, "ConformalFit", "Split-conformal quantiles of |error| / expected error, per axis.")
      .def(py::init([](const std::string& weighting) { return ConformalFit(nn::parse_pixel_weighting(weighting)); }),
           "weighting"_a = "image")
      .def("add", &ConformalFit::add, "expected_error"_a, "error"_a, "valid"_a, Release(),
           "One image: expected_error, error (px) [2, H, W], valid bool [H, W].")
      .def("reaches", &ConformalFit::reaches, "p"_a, "Whether there is a finite factor at share p.")
      .def("factors", &ConformalFit::factors, "levels"_a, "The ConformalFactors at these shares.")
      .def_property_readonly("images", &ConformalFit::images)
      .def_property_readonly("pixels", &ConformalFit::pixels);

  m.def("isotonic_regression", &nn::isotonic_regression, "values"_a, "weights"_a, Release(),
        "The not decreasing sequence nearest to `values` in weighted squares; float64 [K].");
}

}  // namespace

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

  bind_calibration(m);

  py::class_<Metadata>(m, "CheckpointMetadata", "What a checkpoint carries beside the weights.")
      .def(py::init<>())
      .def_readwrite("name", &Metadata::name)
      .def_readwrite("net", &Metadata::net)
      .def_readwrite("flow_scale", &Metadata::flow_scale)
      .def_readwrite("loss", &Metadata::loss)
      .def_readwrite("table", &Metadata::table)
      .def_readwrite("provenance", &Metadata::provenance)
      .def_readwrite("calibration", &Metadata::calibration, "Calibration, or None")
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
