// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <optional>
#include <string>
#include <vector>

#include "ajna/loss/terms.hpp"

namespace ajna::loss {

enum class Reduction { kNone, kMean, kSum };
/// "none", "mean" or "sum"; throws Error(kInvalidArgument) for another name.
Reduction parse_reduction(const std::string& name);

/// What a config chooses; the defaults are the paper's Eq. 1.
struct LossConfig {
  TermSpec f{"l1"};                  ///< distance between prediction and target
  TermSpec h{"inv_softplus"};        ///< attenuation of f, decreasing in raw
  TermSpec g{"softplus"};            ///< penalty, increasing in raw
  double lam = 1.0;                  ///< weight of g, > 0
  TermSpec parametrization{"none"};  ///< a = parametrization(raw)
};

/// Value and first derivatives of h and g in raw, and kappa, at float64 points of raw.
struct LossCurves {
  torch::Tensor raw, h, g, h_slope, g_slope, kappa;
};

/// The generalized heteroscedastic loss, paper Eqs. 11 and 12: E[h(a) f(prediction, target)] + lambda E[g(a)].
///
/// Works for any prediction and raw uncertainty of equal (or broadcastable) shape; all arithmetic is in at least
/// float32, also under autocast. Below kRawMin the loss is continued by its tangent in raw, so that value and gradient
/// stay finite for |raw| to 1e4 and beyond and always point back to the domain; own terms, whose float32 range is
/// unknown, are continued above kOwnRawMax too (g by its tangent, h by a constant). Gradients that go back into
/// float16 saturate at its largest number, 65504, where they would become infinite.
class UncertaintyLoss {
 public:
  static constexpr double kRawMin = -10.0;    ///< softplus(-10) = 4.5e-5: below any error that a flow network reaches
  static constexpr double kOwnRawMax = 64.0;  ///< e^64 = 6e27 still fits float32

  /// Throws Error(kInvalidArgument) for unknown terms or parameters, for expressions that do not parse or are not
  /// finite on a grid of raw in [kRawMin, kOwnRawMax], and for lam that is not finite and positive.
  explicit UncertaintyLoss(const LossConfig& config = {});

  /// prediction, target: [N, C, ...] of one shape and unit; cross_entropy also takes class indices, an integer target
  /// [N, ...] or [N, 1, ...]. raw: the shape of f's value, which is the prediction's, or [N, 1, ...] for terms over the
  /// channel axis; one channel of raw is shared over the axes.
  /// mask: bool or {0, 1}, broadcastable ([N, 1, H, W] or [N, H, W]); where it is false nothing of prediction, raw or
  /// target is read, neither forward nor backward, so NaN and Inf may stand there; a term over the channel axis needs
  /// all of a pixel's channels. weight: >= 0, broadcastable.
  /// kMean divides by the sum of weights over valid elements (0 where there is none); kNone gives zeros in masked
  /// places. Throws Error(kInvalidArgument) where shapes do not fit.
  [[nodiscard]] torch::Tensor operator()(const torch::Tensor& prediction, const torch::Tensor& raw,
                                         const torch::Tensor& target,
                                         const std::optional<torch::Tensor>& mask = std::nullopt,
                                         const std::optional<torch::Tensor>& weight = std::nullopt,
                                         Reduction reduction = Reduction::kMean) const;

  /// g(a(raw)), the paper's uncertainty Y: same shape as raw, float32 or wider.
  [[nodiscard]] torch::Tensor uncertainty(const torch::Tensor& raw) const;
  /// h(a(raw)), the factor of f in the loss, continued as there: same shape as raw, float32 or wider.
  [[nodiscard]] torch::Tensor attenuation(const torch::Tensor& raw) const;
  /// kappa(raw) = -lambda g'(a) / h'(a): the E[f] at which this raw is optimal, in the unit of f. Same shape, no
  /// gradient. Closed form for registered terms, autograd for own ones.
  [[nodiscard]] torch::Tensor expected_error(const torch::Tensor& raw) const;

  /// h and g with their derivatives in raw at `raw` (any shape; float64 out), for checks and plots.
  [[nodiscard]] LossCurves curves(const torch::Tensor& raw) const;

  [[nodiscard]] const LossConfig& config() const noexcept { return config_; }
  /// One line: "f=l1 h=inv_softplus(eps=0.001) g=softplus lam=1 parametrization=none".
  [[nodiscard]] std::string describe() const;

 private:
  /// Where a term is itself; it is continued below `low` and above `high`.
  struct Continuation {
    double low_slope = 0.0, high = 0.0, high_slope = 0.0;
    bool above = false;
  };

  [[nodiscard]] torch::Tensor evaluate(const ScalarTerm& term, const Continuation& ends,
                                       const torch::Tensor& raw) const;
  [[nodiscard]] Continuation continuation(const ScalarTerm& term, bool constant_above) const;
  /// d term / d a at a, closed form or autograd.
  [[nodiscard]] torch::Tensor slope_in_a(const ScalarTerm& term, const torch::Tensor& a) const;
  void probe(const ScalarTerm& term, const std::string& what) const;
  [[nodiscard]] bool is_own(const ScalarTerm& term) const;

  LossConfig config_;
  ErrorTerm f_;
  ScalarTerm h_, g_, parametrization_;
  Continuation h_ends_, g_ends_;
};

/// One scale of a multi-scale network.
struct ScalePrediction {
  torch::Tensor prediction, raw;  ///< [N, C, h, w]
};

/// sum_i scale_weights[i] * loss(scales[i], target averaged to that scale's size), all in the target's unit.
///
/// A coarse target is the mean of the valid target pixels in its cell, and valid where at least one is; `weight` is
/// averaged alike. One weight per scale, finite and >= 0, not all 0; an empty list means 1 each.
/// kNone is refused: scales differ in size.
torch::Tensor multi_scale_loss(const UncertaintyLoss& loss, const std::vector<ScalePrediction>& scales,
                               const torch::Tensor& target, const std::vector<double>& scale_weights = {},
                               const std::optional<torch::Tensor>& mask = std::nullopt,
                               const std::optional<torch::Tensor>& weight = std::nullopt,
                               Reduction reduction = Reduction::kMean);

}  // namespace ajna::loss
