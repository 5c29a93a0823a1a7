// SPDX-License-Identifier: MIT
#include "ajna/base/error.hpp"
#include "ajna/nn/flow_net.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using nn::FlowNetImpl;
using nn::NetConfig;

namespace {

/// The module inside `net` that is called `path` ("" is the network itself).
torch::nn::Module& find_module(FlowNetImpl& net, const std::string& path) {
  const auto modules = net.named_modules(std::string(), false);
  if (path.empty()) {
    return net;
  }
  const auto* found = modules.find(path);
  if (found == nullptr) {
    throw_invalid("network part '" + path + "' does not exist: give a name that named_modules() lists");
  }
  return **found;
}

void bind_flow_net(py::module_& m) {
  // Private to ajna.nn.FlowNet, which mirrors this tree by ordinary Python modules over the same tensors.
  py::class_<FlowNetImpl, std::shared_ptr<FlowNetImpl>>(m, "FlowNetCore",
                                                        "The C++ network behind ajna.nn.FlowNet; use that one.")
      .def(py::init<const NetConfig&>(), "config"_a = NetConfig{}, py::call_guard<py::gil_scoped_release>())
      .def_property_readonly("config", &FlowNetImpl::config, py::return_value_policy::copy)
      .def("forward", &FlowNetImpl::forward, "x"_a, py::call_guard<py::gil_scoped_release>(),
           "[N, in_channels, H, W] float in [-1, 1] -> [N, out_channels, H, W]; any H and W.")
      .def("forward_aligned", &FlowNetImpl::forward_aligned, "x"_a, py::call_guard<py::gil_scoped_release>(),
           "As forward, without padding: both sides are multiples of config.stride.")
      .def("forward_scales", &FlowNetImpl::forward_scales, "x"_a, py::call_guard<py::gil_scoped_release>(),
           "The predictions from coarse to fine, the last at full size; sides are multiples of config.stride.")
      .def("forward_scales_and_layers", &FlowNetImpl::forward_scales_and_layers, "x"_a,
           py::call_guard<py::gil_scoped_release>(), "(forward_scales(x), forward_layers(x)) of one pass.")
      .def("forward_layers", &FlowNetImpl::forward_layers, "x"_a, py::call_guard<py::gil_scoped_release>(),
           "What each layer gives, first to last; both sides are multiples of config.stride.")
      .def(
          "module_names", [](const FlowNetImpl& self) { return self.named_modules(std::string(), false).keys(); },
          "Qualified names of all parts, parents before children.")
      .def(
          "named_parameters",
          [](const FlowNetImpl& self) {
            std::vector<std::pair<std::string, torch::Tensor>> result;
            for (const auto& item : self.named_parameters()) {
              result.emplace_back(item.key(), item.value());
            }
            return result;
          },
          "(qualified name, tensor) pairs; the tensors are the network's own, not copies.")
      .def(
          "named_buffers",
          [](const FlowNetImpl& self) {
            std::vector<std::pair<std::string, torch::Tensor>> result;
            for (const auto& item : self.named_buffers()) {
              result.emplace_back(item.key(), item.value());
            }
            return result;
          },
          "(qualified name, tensor) pairs; the tensors are the network's own, not copies.")
      .def(
          "set_training",
          [](FlowNetImpl& self, const std::string& path, bool on) {
            auto& module = find_module(self, path);
            // Module::train recurses; one part alone is switched by restoring what lies below it.
            std::vector<std::pair<std::shared_ptr<torch::nn::Module>, bool>> below;
            for (const auto& child : module.children()) {
              for (const auto& part : child->modules()) {
                below.emplace_back(part, part->is_training());
              }
            }
            module.train(on);
            for (const auto& [part, was_on] : below) {  // parents first, as train() overwrites what lies below
              if (part->is_training() != was_on) {
                part->train(was_on);
              }
            }
          },
          "path"_a, "on"_a, "Training or evaluation mode of the part `path` alone, without its children.")
      .def(
          "is_training",
          [](FlowNetImpl& self, const std::string& path) { return find_module(self, path).is_training(); }, "path"_a);
}

}  // namespace

void bind_nn(py::module_& m) {
  py::class_<NetConfig>(m, "NetConfig", "Shape of the network; the defaults are the paper's.")
      .def(py::init<>())
      .def_readwrite("in_channels", &NetConfig::in_channels)
      .def_readwrite("out_channels", &NetConfig::out_channels)
      .def_readwrite("width", &NetConfig::width)
      .def_readwrite("expansion", &NetConfig::expansion)
      .def_readwrite("sub_blocks", &NetConfig::sub_blocks)
      .def_readwrite("skip_connections", &NetConfig::skip_connections)
      .def_readwrite("scale_heads", &NetConfig::scale_heads)
      .def_readwrite("correlation_radius", &NetConfig::correlation_radius)
      .def_property_readonly("stride", &NetConfig::stride)
      .def(py::self == py::self);

  bind_flow_net(m);

  m.def("count_macs", &nn::count_macs, "config"_a, "height"_a, "width"_a,
        "Multiply-accumulates of one forward pass at [height, width]; 2 FLOP each.");
}

}  // namespace ajna::bindings
