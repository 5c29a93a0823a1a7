// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <functional>
#include <string>
#include <vector>

#include "ajna/loss/terms.hpp"

namespace ajna::loss {

/// An expression over tensors, checked against a small grammar and then compiled by TorchScript's C++ compiler, so that
/// it is differentiable and runs where its arguments are.
///
/// Grammar: numbers, argument and constant names, + - * / **, parentheses, and the functions of
/// expression_functions(). Nothing else is reachable: no attributes, no strings, no calls of other functions.
class Expression {
 public:
  /// `what` names the term in messages ("loss term h"); `arguments` are the tensors' names, each must occur;
  /// `constants` are further names with their values.
  /// Throws Error(kInvalidArgument), one sentence with the column, for anything outside the grammar and for unknown
  /// names (with the nearest known one).
  Expression(const std::string& what, std::string text, std::vector<std::string> arguments,
             const TermParams& constants);

  /// Values of the arguments in order; all of one dtype and device.
  [[nodiscard]] torch::Tensor operator()(const std::vector<torch::Tensor>& values) const;

  [[nodiscard]] const std::string& text() const noexcept { return text_; }
  /// The TorchScript source that was compiled.
  [[nodiscard]] const std::string& source() const noexcept { return source_; }

 private:
  std::string text_, source_;
  std::function<torch::Tensor(const std::vector<torch::Tensor>&)> run_;
};

/// Whether a term's name is an expression rather than the name of a registered term.
bool is_expression(const std::string& name, const std::vector<std::string>& arguments);

/// abs, acos, clamp(x, low, high), cos, erf, exp, expm1, log, log1p, maximum(x, y), minimum(x, y), norm(x), sigmoid,
/// ...
std::vector<std::string> expression_functions();

}  // namespace ajna::loss
