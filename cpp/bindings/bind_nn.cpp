// SPDX-License-Identifier: MIT
#include "ajna/nn/flow_net.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using nn::FlowNetImpl;
using nn::NetConfig;

void bind_nn(py::module_& m) {
  py::class_<NetConfig>(m, "NetConfig", "Shape of the network; the defaults are the paper's.")
      .def(py::init<>())
      .def_readwrite("in_channels", &NetConfig::in_channels)
      .def_readwrite("out_channels", &NetConfig::out_channels)
      .def_readwrite("width", &NetConfig::width)
      .def_readwrite("expansion", &NetConfig::expansion)
      .def_readwrite("sub_blocks", &NetConfig::sub_blocks)
      .def_property_readonly("stride", &NetConfig::stride)
      .def(py::self == py::self);

  m.def("count_macs", &nn::count_macs, "config"_a, "height"_a, "width"_a,
        "Multiply-accumulates of one forward pass at [height, width]; 2 FLOP each.");
}

}  // namespace ajna::bindings
