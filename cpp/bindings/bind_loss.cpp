// SPDX-License-Identifier: MIT
#include "ajna/loss/uncertainty_loss.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using loss::LossConfig;
using loss::TermSpec;
using loss::UncertaintyLoss;

void bind_loss(py::module_& m) {
  py::class_<TermSpec>(m, "TermSpec", "A loss term by name with its parameters.")
      .def(py::init([](std::string name, loss::TermParams params) {
             return TermSpec{std::move(name), std::move(params)};
           }),
           "name"_a, "params"_a = loss::TermParams{})
      .def_readwrite("name", &TermSpec::name)
      .def_readwrite("params", &TermSpec::params)
      .def("__repr__", [](const TermSpec& spec) { return "TermSpec('" + spec.name + "')"; });

  py::class_<LossConfig>(m, "LossConfig", "Choice of f, h, g, lam and raw -> a; defaults are the paper's Eq. 1.")
      .def(py::init<>())
      .def_readwrite("f", &LossConfig::f)
      .def_readwrite("h", &LossConfig::h)
      .def_readwrite("g", &LossConfig::g)
      .def_readwrite("lam", &LossConfig::lam)
      .def_readwrite("parametrization", &LossConfig::parametrization);

  py::class_<UncertaintyLoss>(m, "UncertaintyLoss", "E[h(a) f(prediction, target)] + lam E[g(a)] (paper Eqs. 11, 12).")
      .def(py::init<const LossConfig&>(), "config"_a = LossConfig{}, py::call_guard<py::gil_scoped_release>())
      .def(
          "__call__",
          [](const UncertaintyLoss& self, const torch::Tensor& prediction, const torch::Tensor& raw,
             const torch::Tensor& target, const std::optional<torch::Tensor>& mask,
             const std::optional<torch::Tensor>& weight, const std::string& reduction) {
            const auto chosen = loss::parse_reduction(reduction);
            const py::gil_scoped_release release;
            return self(prediction, raw, target, mask, weight, chosen);
          },
          "prediction"_a, "raw"_a, "target"_a, "mask"_a = py::none(), "weight"_a = py::none(), "reduction"_a = "mean")
      .def("uncertainty", &UncertaintyLoss::uncertainty, "raw"_a, py::call_guard<py::gil_scoped_release>(),
           "g(a(raw)): the paper's uncertainty, same shape as raw.")
      .def("expected_error", &UncertaintyLoss::expected_error, "raw"_a, py::call_guard<py::gil_scoped_release>(),
           "kappa(raw) = -lam g'/h': the expected f, in the unit of f, same shape as raw.")
      .def_property_readonly("config", &UncertaintyLoss::config)
      .def("__repr__", [](const UncertaintyLoss& self) { return "UncertaintyLoss(" + self.describe() + ")"; });

  m.def("loss_term_names", [] {
    return std::map<std::string, std::vector<std::string>>{{"f", loss::error_term_names()},
                                                           {"h", loss::attenuation_names()},
                                                           {"g", loss::penalty_names()},
                                                           {"parametrization", loss::parametrization_names()}};
  });
}

}  // namespace ajna::bindings
