// SPDX-License-Identifier: MIT
#include "ajna/loss/terms.hpp"

#include <memory>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/loss/expression.hpp"
#include "ajna/loss/registry.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

std::string label(const std::string& kind, const TermSpec& spec) { return kind + " = '" + spec.name + "'"; }

void no_params(const std::string& kind, const TermSpec& spec) {
  if (!spec.params.empty()) {
    throw_invalid(label(kind, spec) + " is a function of yours and takes no parameters: remove '" +
                  spec.params.begin()->first + "'");
  }
}

Tensor same_shape(Tensor result, const Tensor& a, const std::string& what) {
  if (!result.defined() || result.sizes() != a.sizes()) {
    throw_invalid(what + " gives shape " + (result.defined() ? c10::str(result.sizes()) : "'none'") +
                  " for an argument of shape " + c10::str(a.sizes()) + ": return one value per element");
  }
  return result;
}

ScalarTerm scalar(const registry::Registry<registry::Scalar>& entries, const std::string& kind,
                  const std::string& argument, const TermSpec& spec) {
  if (spec.error_function) {
    throw_invalid(label(kind, spec) + " is a function of (prediction, target): give one of " + argument);
  }
  if (spec.function) {
    no_params(kind, spec);
    auto value = [function = spec.function, what = label(kind, spec)](const Tensor& a) {
      return same_shape(function(a), a, what);
    };
    return {spec.name, {}, std::move(value), {}, TermOrigin::kFunction};
  }
  // A registered name wins over an argument's: 'a' alone is an expression, 'log' is not.
  if (is_expression(spec.name, {argument})) {
    const auto expression =
        std::make_shared<Expression>(kind, spec.name, std::vector<std::string>{argument}, spec.params);
    auto value = [expression, what = label(kind, spec)](const Tensor& a) {
      return same_shape((*expression)({a}), a, what);
    };
    return {spec.name, spec.params, std::move(value), {}, TermOrigin::kExpression};
  }
  auto [made, params] = registry::build(entries, kind, spec);
  return {spec.name, std::move(params), std::move(made.value), std::move(made.slope), TermOrigin::kRegistered};
}

/// An expression for f must be finite on ordinary, positive values, three channels of them.
void probe(const ErrorTerm& term) {
  const c10::InferenceMode normal_mode(false);
  const torch::AutoGradMode with_grad(true);
  const auto options = torch::TensorOptions().dtype(torch::kFloat64);
  const auto p = torch::linspace(0.05, 0.95, 24, options).view({1, 3, 1, 8}).requires_grad_(true);
  const auto t = torch::linspace(0.9, 0.02, 24, options).view({1, 3, 1, 8});
  const auto value = term.value(p, t);
  const auto finite = [&](const Tensor& x, const char* what) {
    const auto bad = x.isfinite().logical_not().nonzero();
    if (bad.numel() == 0) return;
    const auto at = bad[0];
    const auto where = [&](const Tensor& full) {
      return full.index({0, at[1].item<std::int64_t>(), 0, at[3].item<std::int64_t>()}).item<double>();
    };
    throw_invalid("loss term f = '" + term.name + "' has a " + what + " that is not finite at prediction = " +
                  c10::str(where(p)) + ", target = " + c10::str(where(t)) + ": change the expression");
  };
  finite(value, "value");
  finite(torch::autograd::grad({value.sum()}, {p})[0], "gradient");
}

}  // namespace

ErrorTerm make_error_term(const TermSpec& spec) {
  const std::string kind = "loss term f";
  if (spec.function) {
    throw_invalid(label(kind, spec) + " is a function of one argument: give one of (prediction, target)");
  }
  if (spec.error_function) {
    no_params(kind, spec);
    return {spec.name, {}, spec.error_function, TermOrigin::kFunction};
  }
  const std::vector<std::string> arguments = {"prediction", "target"};
  if (is_expression(spec.name, {})) {
    const auto expression = std::make_shared<Expression>(kind, spec.name, arguments, spec.params);
    auto value = [expression](const Tensor& p, const Tensor& t) { return (*expression)({p, t}); };
    ErrorTerm term{spec.name, spec.params, std::move(value), TermOrigin::kExpression};
    probe(term);
    return term;
  }
  auto [value, params] = registry::build(registry::error_terms(), kind, spec);
  return {spec.name, std::move(params), std::move(value), TermOrigin::kRegistered};
}

ScalarTerm make_attenuation(const TermSpec& spec) { return scalar(registry::attenuations(), "loss term h", "a", spec); }
ScalarTerm make_penalty(const TermSpec& spec) { return scalar(registry::penalties(), "loss term g", "a", spec); }
ScalarTerm make_parametrization(const TermSpec& spec) {
  return scalar(registry::parametrizations(), "parametrization", "raw", spec);
}

std::vector<std::string> error_term_names() { return registry::names(registry::error_terms()); }
std::vector<std::string> attenuation_names() { return registry::names(registry::attenuations()); }
std::vector<std::string> penalty_names() { return registry::names(registry::penalties()); }
std::vector<std::string> parametrization_names() { return registry::names(registry::parametrizations()); }

}  // namespace ajna::loss
