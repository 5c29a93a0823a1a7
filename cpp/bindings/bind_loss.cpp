// SPDX-License-Identifier: MIT
#include <pybind11/functional.h>

#include "ajna/loss/admissibility.hpp"
#include "ajna/loss/expression.hpp"
#include "ajna/loss/likelihood.hpp"
#include "ajna/loss/presets.hpp"
#include "ajna/loss/uncertainty_loss.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using loss::AdmissibilityReport;
using loss::Likelihood;
using loss::LossConfig;
using loss::Preset;
using loss::TermSpec;
using loss::UncertaintyLoss;
using torch::Tensor;
using Release = py::call_guard<py::gil_scoped_release>;

namespace {

void bind_config(py::module_& m) {
  py::class_<TermSpec>(m, "TermSpec", "A loss term: a registered name, an expression, or a function with a label.")
      .def(py::init([](std::string name, loss::TermParams params, loss::ScalarFunction function,
                       loss::ErrorFunction error_function) {
             return TermSpec{std::move(name), std::move(params), std::move(function), std::move(error_function)};
           }),
           "name"_a, "params"_a = loss::TermParams{}, "function"_a = py::none(), "error_function"_a = py::none())
      .def_readwrite("name", &TermSpec::name)
      .def_readwrite("params", &TermSpec::params)
      .def_property_readonly("is_function", [](const TermSpec& s) { return s.function || s.error_function; })
      .def("__repr__", [](const TermSpec& spec) { return "TermSpec('" + spec.name + "')"; });

  py::class_<LossConfig>(m, "LossConfig", "Choice of f, h, g, lam and raw -> a; defaults are the paper's Eq. 1.")
      .def(py::init<>())
      .def_readwrite("f", &LossConfig::f)
      .def_readwrite("h", &LossConfig::h)
      .def_readwrite("g", &LossConfig::g)
      .def_readwrite("lam", &LossConfig::lam)
      .def_readwrite("parametrization", &LossConfig::parametrization);

  py::class_<Preset>(m, "LossPreset", "A published loss: a row of Table 3, Eq. 1, or a row as printed.")
      .def_readonly("name", &Preset::name)
      .def_readonly("reference", &Preset::reference)
      .def_readonly("citation", &Preset::citation)
      .def_readonly("quantity", &Preset::quantity)
      .def_readonly("printed_f", &Preset::printed_f)
      .def_readonly("printed_h", &Preset::printed_h)
      .def_readonly("printed_g", &Preset::printed_g)
      .def_readonly("printed_lam", &Preset::printed_lam)
      .def_readonly("kappa", &Preset::kappa)
      .def_readonly("note", &Preset::note)
      .def_readonly("config", &Preset::config, py::return_value_policy::copy)
      .def("__repr__", [](const Preset& preset) { return "LossPreset('" + preset.name + "')"; });
}

void bind_analysis(py::module_& m) {
  py::class_<AdmissibilityReport>(m, "AdmissibilityReport", "Whether raw measures the expected error, and where not.")
      .def_readonly("admissible", &AdmissibilityReport::admissible)
      .def_readonly("raw_min", &AdmissibilityReport::raw_min)
      .def_readonly("raw_max", &AdmissibilityReport::raw_max)
      .def_readonly("fails_at", &AdmissibilityReport::fails_at)
      .def_readonly("reason", &AdmissibilityReport::reason)
      .def_readonly("error_min", &AdmissibilityReport::error_min)
      .def_readonly("error_max", &AdmissibilityReport::error_max)
      .def("__bool__", [](const AdmissibilityReport& report) { return report.admissible; })
      .def("__repr__", [](const AdmissibilityReport& report) {
        return report.admissible ? std::string("AdmissibilityReport(admissible)")
                                 : "AdmissibilityReport(" + report.reason + ")";
      });

  py::class_<Likelihood>(m, "Likelihood", "The error distribution whose negative log-likelihood a loss is.")
      .def_static("of", &Likelihood::of, "loss"_a, "channels"_a = 1, Release())
      .def_static("require", &Likelihood::require, "loss"_a, "channels"_a = 1, Release())
      .def_property_readonly("name", &Likelihood::name)
      .def_property_readonly("factor", &Likelihood::factor)
      .def_property_readonly("is_normalised", &Likelihood::is_normalised)
      .def("scale", &Likelihood::scale, "raw"_a, Release())
      .def("nll", &Likelihood::nll, "prediction"_a, "raw"_a, "target"_a, Release())
      .def("crps", &Likelihood::crps, "prediction"_a, "raw"_a, "target"_a, Release())
      .def("cdf", &Likelihood::cdf, "x"_a, "raw"_a, Release())
      .def("quantile", &Likelihood::quantile, "p"_a, "raw"_a, Release())
      .def("interval", &Likelihood::interval, "p"_a, "raw"_a, Release())
      .def("sample", &Likelihood::sample, "raw"_a, Release());
}

}  // namespace

void bind_loss(py::module_& m) {
  bind_config(m);
  py::class_<UncertaintyLoss>(m, "UncertaintyLoss", "E[h(a) f(prediction, target)] + lam E[g(a)] (paper Eqs. 11, 12).")
      .def(py::init<const LossConfig&>(), "config"_a = LossConfig{}, Release())
      .def(
          "__call__",
          [](const UncertaintyLoss& self, const Tensor& prediction, const Tensor& raw, const Tensor& target,
             const std::optional<Tensor>& mask, const std::optional<Tensor>& weight, const std::string& reduction) {
            const auto chosen = loss::parse_reduction(reduction);
            const py::gil_scoped_release release;
            return self(prediction, raw, target, mask, weight, chosen);
          },
          "prediction"_a, "raw"_a, "target"_a, "mask"_a = py::none(), "weight"_a = py::none(), "reduction"_a = "mean")
      .def(
          "multi_scale",
          [](const UncertaintyLoss& self, const std::vector<Tensor>& predictions, const std::vector<Tensor>& raws,
             const Tensor& target, const std::vector<double>& scale_weights, const std::optional<Tensor>& mask,
             const std::optional<Tensor>& weight, const std::string& reduction) {
            if (predictions.size() != raws.size()) {
              throw py::value_error(std::to_string(predictions.size()) + " predictions but " +
                                    std::to_string(raws.size()) + " raw uncertainties: give one raw per prediction");
            }
            const auto chosen = loss::parse_reduction(reduction);
            std::vector<loss::ScalePrediction> scales;
            for (std::size_t i = 0; i < predictions.size(); ++i) {
              scales.push_back({predictions[i], raws[i]});
            }
            const py::gil_scoped_release release;
            return loss::multi_scale_loss(self, scales, target, scale_weights, mask, weight, chosen);
          },
          "predictions"_a, "raws"_a, "target"_a, "scale_weights"_a = std::vector<double>{}, "mask"_a = py::none(),
          "weight"_a = py::none(), "reduction"_a = "mean")
      .def("uncertainty", &UncertaintyLoss::uncertainty, "raw"_a, Release(),
           "g(a(raw)): the paper's uncertainty, same shape as raw.")
      .def("attenuation", &UncertaintyLoss::attenuation, "raw"_a, Release(), "h(a(raw)), same shape as raw.")
      .def("expected_error", &UncertaintyLoss::expected_error, "raw"_a, Release(),
           "kappa(raw) = -lam g'/h': the expected f, in the unit of f, same shape as raw.")
      .def(
          "curves",
          [](const UncertaintyLoss& self, const Tensor& raw) {
            const auto c = self.curves(raw);
            return std::map<std::string, Tensor>{
                {"raw", c.raw},         {"h", c.h},        {"g", c.g}, {"h_slope", c.h_slope},
                {"g_slope", c.g_slope}, {"kappa", c.kappa}};
          },
          "raw"_a, Release(), "h, g, their slopes in raw and kappa as float64 tensors.")
      .def("check", &loss::check, "raw_min"_a = UncertaintyLoss::kRawMin, "raw_max"_a = UncertaintyLoss::kOwnRawMax,
           Release(), "Whether raw measures the expected error over a domain.")
      .def("describe", &UncertaintyLoss::describe)
      // A copy: to change it would change half of the loss.
      .def_property_readonly("config", &UncertaintyLoss::config, py::return_value_policy::copy)
      .def("__repr__", [](const UncertaintyLoss& self) { return "UncertaintyLoss(" + self.describe() + ")"; });
  bind_analysis(m);

  m.def("loss_presets", [] { return loss::presets(); });
  m.def(
      "loss_preset", [](const std::string& name) { return loss::preset(name); }, "name"_a);
  m.def("loss_expression_functions", &loss::expression_functions);
  m.def("loss_term_names", [] {
    return std::map<std::string, std::vector<std::string>>{{"f", loss::error_term_names()},
                                                           {"h", loss::attenuation_names()},
                                                           {"g", loss::penalty_names()},
                                                           {"parametrization", loss::parametrization_names()}};
  });
}

}  // namespace ajna::bindings
