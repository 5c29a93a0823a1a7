// SPDX-License-Identifier: MIT
#include "ajna/loss/terms.hpp"

#include <cmath>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

template <class Function>
struct Entry {
  TermParams defaults;
  std::function<Function(const TermParams&)> make;
};
using ErrorFunction = std::function<Tensor(const Tensor&, const Tensor&)>;
using ScalarFunction = std::function<Tensor(const Tensor&)>;
template <class Function>
using Registry = std::map<std::string, Entry<Function>>;

const Registry<ErrorFunction>& error_terms() {
  static const Registry<ErrorFunction> registry = {
      {"l1", {{}, [](const TermParams&) { return [](const Tensor& p, const Tensor& t) { return (p - t).abs(); }; }}},
      {"squared_error",
       {{}, [](const TermParams&) { return [](const Tensor& p, const Tensor& t) { return (p - t).square(); }; }}},
      {"charbonnier",
       {{{"eps", 1e-3}},
        [](const TermParams& params) {
          const double eps = params.at("eps");
          return [eps](const Tensor& p, const Tensor& t) { return ((p - t).square() + eps * eps).sqrt() - eps; };
        }}},
  };
  return registry;
}

const Registry<ScalarFunction>& attenuations() {
  static const Registry<ScalarFunction> registry = {
      // Paper Eq. 1: 1 / log(1 + e^(a + eps)); note that eps sits inside the exponent.
      {"inv_softplus",
       {{{"eps", 1e-3}},
        [](const TermParams& params) {
          const double eps = params.at("eps");
          return [eps](const Tensor& a) { return torch::softplus(a + eps).reciprocal(); };
        }}},
      {"inv", {{}, [](const TermParams&) { return [](const Tensor& a) { return a.reciprocal(); }; }}},
      {"inv_square", {{}, [](const TermParams&) { return [](const Tensor& a) { return a.square().reciprocal(); }; }}},
  };
  return registry;
}

const Registry<ScalarFunction>& penalties() {
  static const Registry<ScalarFunction> registry = {
      {"softplus", {{}, [](const TermParams&) { return [](const Tensor& a) { return torch::softplus(a); }; }}},
      {"log", {{}, [](const TermParams&) { return [](const Tensor& a) { return a.log(); }; }}},
      {"log_square", {{}, [](const TermParams&) { return [](const Tensor& a) { return a.square().log(); }; }}},
  };
  return registry;
}

const Registry<ScalarFunction>& parametrizations() {
  static const Registry<ScalarFunction> registry = {
      {"none", {{}, [](const TermParams&) { return [](const Tensor& raw) { return raw; }; }}},
      {"softplus", {{}, [](const TermParams&) { return [](const Tensor& raw) { return torch::softplus(raw); }; }}},
      {"exp", {{}, [](const TermParams&) { return [](const Tensor& raw) { return raw.exp(); }; }}},
  };
  return registry;
}

template <class Function>
std::vector<std::string> names(const Registry<Function>& registry) {
  std::vector<std::string> result;
  for (const auto& [name, entry] : registry) {
    result.push_back(name);
  }
  return result;
}

template <class Function>
std::pair<Function, TermParams> build(const Registry<Function>& registry, const std::string& kind,
                                      const TermSpec& spec) {
  const auto found = registry.find(spec.name);
  if (found == registry.end()) {
    throw_unknown(kind, spec.name, names(registry));
  }
  TermParams params = found->second.defaults;
  std::vector<std::string> known;
  for (const auto& [name, value] : params) {
    known.push_back(name);
  }
  for (const auto& [name, value] : spec.params) {
    if (params.find(name) == params.end()) {
      if (known.empty()) {
        throw_invalid(kind + " '" + spec.name + "' takes no parameters: remove '" + name + "'");
      }
      throw_unknown("parameter of " + kind + " '" + spec.name + "'", name, known);
    }
    if (!std::isfinite(value)) {
      throw_invalid("parameter '" + name + "' of " + kind + " '" + spec.name + "' is not finite: give a number");
    }
    params[name] = value;
  }
  return {found->second.make(params), params};
}

ScalarTerm scalar(const Registry<ScalarFunction>& registry, const std::string& kind, const TermSpec& spec) {
  auto [value, params] = build(registry, kind, spec);
  return {spec.name, std::move(params), std::move(value)};
}

}  // namespace

ErrorTerm make_error_term(const TermSpec& spec) {
  auto [value, params] = build(error_terms(), "loss term f", spec);
  return {spec.name, std::move(params), std::move(value)};
}

ScalarTerm make_attenuation(const TermSpec& spec) { return scalar(attenuations(), "loss term h", spec); }
ScalarTerm make_penalty(const TermSpec& spec) { return scalar(penalties(), "loss term g", spec); }
ScalarTerm make_parametrization(const TermSpec& spec) { return scalar(parametrizations(), "parametrization", spec); }

std::vector<std::string> error_term_names() { return names(error_terms()); }
std::vector<std::string> attenuation_names() { return names(attenuations()); }
std::vector<std::string> penalty_names() { return names(penalties()); }
std::vector<std::string> parametrization_names() { return names(parametrizations()); }

}  // namespace ajna::loss
