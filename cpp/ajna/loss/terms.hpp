// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <functional>
#include <map>
#include <string>
#include <vector>

namespace ajna::loss {

using TermParams = std::map<std::string, double>;
/// f(prediction, target): element-wise, or over the channel axis (1) with one channel out.
using ErrorFunction = std::function<torch::Tensor(const torch::Tensor& prediction, const torch::Tensor& target)>;
/// h(a), g(a) or a(raw): element-wise.
using ScalarFunction = std::function<torch::Tensor(const torch::Tensor& a)>;

/// A term as it stands in a config: a registered name with its parameters ({name: inv_softplus, params: {eps: 1e-3}}),
/// an expression ("1 / log(1 + exp(a + eps))", its constants in params), or, from code, a function with a label.
struct TermSpec {
  std::string name;  ///< registered name, expression, or the label of the function below
  TermParams params{};
  ScalarFunction function{};       ///< own h, g or parametrization
  ErrorFunction error_function{};  ///< own f
};

/// How a term came about; own terms are continued by their tangent (h: by a constant) above kOwnRawMax.
enum class TermOrigin { kRegistered, kExpression, kFunction };

/// f(prediction, target) >= 0. Unit: that of the targets (l1), its square (squared_error), radians (angular), nats
/// (cross_entropy).
struct ErrorTerm {
  std::string name;
  TermParams params;
  ErrorFunction value;
  TermOrigin origin = TermOrigin::kRegistered;
};

/// h(a) or g(a), element-wise and differentiable by autograd.
struct ScalarTerm {
  std::string name;
  TermParams params;
  ScalarFunction value;
  ScalarFunction slope{};  ///< closed form of d value / d a; empty for own terms (autograd then)
  TermOrigin origin = TermOrigin::kRegistered;
};

/// Build a term; parameters not given take their defaults.
/// Throw Error(kInvalidArgument), one sentence, for an unknown name or parameter (with the nearest known one), a value
/// that is not finite or out of range, an expression that does not parse, and a function of another shape.

/// f: l1, l2, squared_error, squared_l2, smooth_l1(beta), charbonnier(eps), huber(delta), angular, cross_entropy.
ErrorTerm make_error_term(const TermSpec& spec);
/// h: inv, inv_square, inv_softplus(eps), inv_softplus_square, exp_neg, identity, neg, one.
ScalarTerm make_attenuation(const TermSpec& spec);
/// g: softplus, log, log_square, neg_log, identity, square, angular_vmf, angular_printed.
ScalarTerm make_penalty(const TermSpec& spec);
/// raw -> a: none, softplus, exp(scale), so that 1/a and log(a) never see a <= 0; confidence, which falls from 1 to 0.
ScalarTerm make_parametrization(const TermSpec& spec);

std::vector<std::string> error_term_names();
std::vector<std::string> attenuation_names();
std::vector<std::string> penalty_names();
std::vector<std::string> parametrization_names();

}  // namespace ajna::loss
