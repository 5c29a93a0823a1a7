// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <functional>
#include <map>
#include <string>
#include <vector>

namespace ajna::loss {

using TermParams = std::map<std::string, double>;

/// A term by name with its parameters, as it stands in a config: {name: inv_softplus, params: {eps: 1e-3}}.
struct TermSpec {
  std::string name;
  TermParams params{};
};

/// f(prediction, target): element-wise distance, same shape as its arguments, >= 0. Unit: that of the targets (l1), or
/// its square (squared_error).
struct ErrorTerm {
  std::string name;
  TermParams params;
  std::function<torch::Tensor(const torch::Tensor& prediction, const torch::Tensor& target)> value;
};

/// h(a) or g(a), element-wise and differentiable by autograd.
struct ScalarTerm {
  std::string name;
  TermParams params;
  std::function<torch::Tensor(const torch::Tensor& a)> value;
};

/// Build a term by name; parameters not given take their defaults.
/// Throw Error(kInvalidArgument) for an unknown name or parameter (with the nearest known one) or a non-finite value.
ErrorTerm make_error_term(const TermSpec& spec);    ///< f: l1, squared_error, charbonnier(eps)
ScalarTerm make_attenuation(const TermSpec& spec);  ///< h: inv_softplus(eps), inv, inv_square
ScalarTerm make_penalty(const TermSpec& spec);      ///< g: softplus, log, log_square
/// raw -> a: none (a = raw), softplus, exp; so that 1/a and log(a) never see a <= 0.
ScalarTerm make_parametrization(const TermSpec& spec);

std::vector<std::string> error_term_names();
std::vector<std::string> attenuation_names();
std::vector<std::string> penalty_names();
std::vector<std::string> parametrization_names();

}  // namespace ajna::loss
