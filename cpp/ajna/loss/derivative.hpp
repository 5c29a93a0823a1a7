// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <string>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/loss/terms.hpp"

namespace ajna::loss::detail {

/// An element-wise function's value and derivative at x by autograd, without touching the caller's graph; also where
/// the caller is in inference mode (validation loops), which could build no graph.
inline std::pair<torch::Tensor, torch::Tensor> value_and_slope(const ScalarFunction& function, const torch::Tensor& x,
                                                               const std::string& what) {
  const c10::InferenceMode normal_mode(false);
  const torch::AutoGradMode with_grad(true);
  const auto point = x.detach().clone().requires_grad_(true);
  const auto value = function(point);
  if (!value.requires_grad()) {
    throw_invalid(what +
                  " cannot be differentiated: it must depend on its argument by differentiable torch operations");
  }
  auto slope = torch::autograd::grad({value.sum()}, {point})[0];
  return {value.detach(), std::move(slope)};
}

}  // namespace ajna::loss::detail
