// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <optional>
#include <string>

#include "ajna/loss/terms.hpp"

namespace ajna::loss {

enum class Reduction { kNone, kMean, kSum };
/// "none", "mean" or "sum"; throws Error(kInvalidArgument) for another name.
Reduction parse_reduction(const std::string& name);

/// What a config chooses; the defaults are the paper's Eq. 1.
struct LossConfig {
  TermSpec f{"l1"};                  ///< distance between prediction and target
  TermSpec h{"inv_softplus"};        ///< attenuation of f, decreasing in a
  TermSpec g{"softplus"};            ///< penalty on a, increasing
  double lam = 1.0;                  ///< weight of g, > 0
  TermSpec parametrization{"none"};  ///< a = parametrization(raw)
};

/// The generalized heteroscedastic loss, paper Eqs. 11 and 12: E[h(a) f(prediction, target)] + lambda E[g(a)].
///
/// Works for any prediction and raw uncertainty of equal (or broadcastable) shape; all arithmetic is in at least
/// float32, also under autocast. Below kRawMin the loss is continued by its tangent in raw, so that
/// value and gradient stay finite for |raw| to 1e4 and beyond and always point back to the domain.
class UncertaintyLoss {
 public:
  static constexpr double kRawMin = -10.0;  ///< softplus(-10) = 4.5e-5: below any error that a flow network reaches

  /// Throws Error(kInvalidArgument) for unknown terms or parameters and for lam that is not finite and positive.
  explicit UncertaintyLoss(const LossConfig& config = {});

  /// prediction, raw, target: [N, C, ...] of one shape (raw may have one channel: shared over the axes).
  /// mask: bool or {0, 1}, broadcastable ([N, 1, H, W] or [N, H, W]); where it is false nothing of prediction, raw or
  /// target is read, neither forward nor backward, so NaN and Inf may stand there. weight: >= 0, broadcastable.
  /// kMean divides by the sum of weights over valid elements (0 where there is none); kNone gives zeros in masked
  /// places. Throws Error(kInvalidArgument) where shapes do not fit.
  [[nodiscard]] torch::Tensor operator()(const torch::Tensor& prediction, const torch::Tensor& raw,
                                         const torch::Tensor& target,
                                         const std::optional<torch::Tensor>& mask = std::nullopt,
                                         const std::optional<torch::Tensor>& weight = std::nullopt,
                                         Reduction reduction = Reduction::kMean) const;

  /// g(a(raw)), the paper's uncertainty Y: same shape as raw, float32 or wider.
  [[nodiscard]] torch::Tensor uncertainty(const torch::Tensor& raw) const;
  /// kappa(raw) = -lambda g'(raw) / h'(raw): the E[f] at which this raw is optimal, in the unit of f. Same shape.
  [[nodiscard]] torch::Tensor expected_error(const torch::Tensor& raw) const;

  [[nodiscard]] const LossConfig& config() const noexcept { return config_; }
  /// One line: "f=l1 h=inv_softplus(eps=0.001) g=softplus lam=1 parametrization=none".
  [[nodiscard]] std::string describe() const;

 private:
  /// term(a(raw)), continued by its tangent below kRawMin.
  [[nodiscard]] torch::Tensor evaluate(const ScalarTerm& term, double slope, const torch::Tensor& raw) const;
  /// d term(a(raw)) / d raw by autograd, without touching the caller's graph.
  [[nodiscard]] torch::Tensor derivative(const ScalarTerm& term, const torch::Tensor& raw) const;

  [[nodiscard]] double slope_at_min(const ScalarTerm& term) const;

  LossConfig config_;
  ErrorTerm f_;
  ScalarTerm h_, g_, parametrization_;
  double h_slope_ = 0.0, g_slope_ = 0.0;  // d h / d raw and d g / d raw at kRawMin
};

}  // namespace ajna::loss
