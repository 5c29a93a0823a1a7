// SPDX-License-Identifier: MIT
#include <cmath>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/loss/uncertainty_loss.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

/// [N, H, W] or broadcastable [N, 1 or C, H, W] -> full [N, 1 or C, H, W].
Tensor map_like(const Tensor& x, const Tensor& target, const char* what) {
  auto result = x.dim() == 3 ? x.unsqueeze(1) : x;
  const bool fits = result.dim() == 4 && (result.size(1) == 1 || result.size(1) == target.size(1)) &&
                    result.size(2) == target.size(2) && result.size(3) == target.size(3) &&
                    (result.size(0) == 1 || result.size(0) == target.size(0));
  if (!fits) {
    throw_invalid(std::string(what) + " of shape " + c10::str(x.sizes()) + " does not fit a target of shape " +
                  c10::str(target.sizes()) + ": give [N, 1, H, W], [N, H, W] or the target's shape");
  }
  return result.expand({target.size(0), result.size(1), target.size(2), target.size(3)});
}

void check(const std::vector<ScalePrediction>& scales, const Tensor& target, const std::vector<double>& weights,
           Reduction reduction) {
  if (scales.empty()) {
    throw_invalid("a multi-scale loss got no scales: give at least one prediction");
  }
  if (target.dim() != 4 || !target.is_floating_point()) {
    throw_invalid("multi-scale target has shape " + c10::str(target.sizes()) + " and type " +
                  c10::toString(target.scalar_type()) + ": give floating point [N, C, H, W]");
  }
  if (reduction == Reduction::kNone) {
    throw_invalid("reduction 'none' of a multi-scale loss is undefined, as scales differ in size: choose mean or sum");
  }
  if (!weights.empty() && weights.size() != scales.size()) {
    throw_invalid(std::to_string(weights.size()) + " scale weights for " + std::to_string(scales.size()) +
                  " scales: give one per scale");
  }
  double total = weights.empty() ? 1.0 : 0.0;
  for (const double weight : weights) {
    if (!std::isfinite(weight) || weight < 0) {
      throw_invalid("scale weight " + std::to_string(weight) + ": give finite numbers of at least 0");
    }
    total += weight;
  }
  if (total <= 0) {
    throw_invalid("all scale weights are 0: give at least one above 0");
  }
  for (const auto& scale : scales) {
    const auto& p = scale.prediction;
    if (p.dim() != 4 || p.size(0) != target.size(0) || p.size(1) != target.size(1) || p.size(2) > target.size(2) ||
        p.size(3) > target.size(3)) {
      throw_invalid("prediction of shape " + c10::str(p.sizes()) + " is no coarser scale of a target of shape " +
                    c10::str(target.sizes()) + ": give [N, C, h, w] with h <= H and w <= W");
    }
  }
}

}  // namespace

Tensor multi_scale_loss(const UncertaintyLoss& loss, const std::vector<ScalePrediction>& scales, const Tensor& target,
                        const std::vector<double>& scale_weights, const std::optional<Tensor>& mask,
                        const std::optional<Tensor>& weight, Reduction reduction) {
  check(scales, target, scale_weights, reduction);
  const auto type = target.scalar_type() == torch::kFloat64 ? torch::kFloat64 : torch::kFloat32;
  const auto full = target.to(type);
  std::optional<Tensor> valid, weights;
  if (mask) valid = map_like(mask->to(torch::kBool), target, "mask");
  if (weight) weights = map_like(weight->to(type), target, "weight");
  Tensor total;
  for (std::size_t i = 0; i < scales.size(); ++i) {
    const double share = scale_weights.empty() ? 1.0 : scale_weights[i];
    if (share == 0.0) continue;
    const auto& prediction = scales[i].prediction;
    const std::vector<std::int64_t> size = {prediction.size(2), prediction.size(3)};
    const auto pool = [&](const Tensor& x) { return torch::adaptive_avg_pool2d(x, size); };
    auto coarse = full;
    auto coarse_valid = valid;
    auto coarse_weight = weights;
    if (prediction.size(2) != full.size(2) || prediction.size(3) != full.size(3)) {
      if (valid) {
        const auto zero = torch::zeros({}, full.options());
        const auto share_valid = pool(valid->to(type));
        const auto safe = share_valid.clamp_min(1e-12);
        coarse = pool(torch::where(*valid, full, zero)) / safe;
        coarse_valid = share_valid > 0;
        if (weights) coarse_weight = pool(torch::where(*valid, *weights, zero)) / safe;
      } else {
        coarse = pool(full);
        if (weights) coarse_weight = pool(*weights);
      }
    }
    const auto part = share * loss(prediction, scales[i].raw, coarse, coarse_valid, coarse_weight, reduction);
    total = total.defined() ? total + part : part;
  }
  return total;
}

}  // namespace ajna::loss
