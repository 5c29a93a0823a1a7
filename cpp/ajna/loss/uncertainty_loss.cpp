// SPDX-License-Identifier: MIT
#include "ajna/loss/uncertainty_loss.hpp"

#include <cmath>
#include <sstream>

#include "ajna/base/error.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

/// Half precision is too narrow for h: compute in float32 there, in the given precision otherwise.
Tensor widen(const Tensor& x) {
  return x.scalar_type() == torch::kHalf || x.scalar_type() == torch::kBFloat16 ? x.to(torch::kFloat32) : x;
}

std::string shape_text(const Tensor& x) { return c10::str(x.sizes()); }

/// Masks and weights may come as [N, H, W] beside [N, C, H, W] predictions.
Tensor match_dims(const Tensor& x, const Tensor& like, const char* what) {
  Tensor result = x.dim() == like.dim() - 1 && like.dim() >= 2 ? x.unsqueeze(1) : x;
  bool fits = result.dim() == like.dim();
  for (std::int64_t d = 0; fits && d < like.dim(); ++d) {
    fits = result.size(d) == like.size(d) || result.size(d) == 1;
  }
  if (!fits) {
    throw_invalid(std::string(what) + " of shape " + shape_text(x) + " does not fit a prediction of shape " +
                  shape_text(like) + ": give [N, 1, H, W], [N, H, W] or the prediction's shape");
  }
  return result;
}

std::string term_text(const std::string& name, const TermParams& params) {
  std::ostringstream text;
  text << name;
  if (!params.empty()) {
    text << '(';
    const char* separator = "";
    for (const auto& [key, value] : params) {
      text << separator << key << '=' << value;
      separator = ", ";
    }
    text << ')';
  }
  return text.str();
}

}  // namespace

Reduction parse_reduction(const std::string& name) {
  if (name == "none") return Reduction::kNone;
  if (name == "mean") return Reduction::kMean;
  if (name == "sum") return Reduction::kSum;
  throw_unknown("reduction", name, {"none", "mean", "sum"});
}

UncertaintyLoss::UncertaintyLoss(const LossConfig& config)
    : config_(config),
      f_(make_error_term(config.f)),
      h_(make_attenuation(config.h)),
      g_(make_penalty(config.g)),
      parametrization_(make_parametrization(config.parametrization)) {
  if (!std::isfinite(config.lam) || config.lam <= 0) {
    throw_invalid("loss weight lam = " + std::to_string(config.lam) + ": give a finite number above 0");
  }
  h_slope_ = slope_at_min(h_);
  g_slope_ = slope_at_min(g_);
}

Tensor UncertaintyLoss::derivative(const ScalarTerm& term, const Tensor& raw) const {
  // Validation loops run in inference mode, where no graph can be built: leave it for this computation.
  const c10::InferenceMode normal_mode(false);
  const torch::AutoGradMode with_grad(true);
  const auto x = raw.detach().to(torch::kFloat64).clone().requires_grad_(true);
  const auto y = term.value(parametrization_.value(x));
  return torch::autograd::grad({y.sum()}, {x})[0].to(raw.scalar_type());
}

double UncertaintyLoss::slope_at_min(const ScalarTerm& term) const {
  return derivative(term, torch::full({}, kRawMin, torch::kFloat64)).item<double>();
}

Tensor UncertaintyLoss::evaluate(const ScalarTerm& term, double slope, const Tensor& raw) const {
  // The tangent at kRawMin keeps value and gradient finite where h itself would overflow, and still pulls raw back.
  return term.value(parametrization_.value(raw.clamp_min(kRawMin))) + slope * (raw - kRawMin).clamp_max(0.0);
}

Tensor UncertaintyLoss::operator()(const Tensor& prediction, const Tensor& raw, const Tensor& target,
                                   const std::optional<Tensor>& mask, const std::optional<Tensor>& weight,
                                   Reduction reduction) const {
  if (prediction.sizes() != target.sizes()) {
    throw_invalid("prediction " + shape_text(prediction) + " and target " + shape_text(target) +
                  " differ in shape: give tensors of one shape");
  }
  auto p = widen(prediction), t = widen(target).to(p.scalar_type());
  auto r = match_dims(widen(raw), p, "raw uncertainty");
  Tensor valid;
  if (mask) {
    valid = match_dims(mask->to(torch::kBool), p, "mask").expand_as(p);
    // Select before the arithmetic: 0 * NaN is NaN, so masking afterwards would not guard.
    const auto zero = torch::zeros({}, p.options());
    p = torch::where(valid, p, zero);
    t = torch::where(valid, t, zero);
    // 1, not 0: 1/a and log(a) must be finite there, or 0 * Inf would come back as NaN.
    r = torch::where(valid, r.expand_as(p), torch::ones({}, r.options()));
  }
  auto loss = evaluate(h_, h_slope_, r) * f_.value(p, t) + config_.lam * evaluate(g_, g_slope_, r);
  auto weights = valid.defined() ? valid.to(loss.scalar_type()) : torch::ones({}, loss.options());
  if (weight) {
    auto w = match_dims(widen(*weight), p, "weight").to(loss.scalar_type());
    if (valid.defined()) {
      w = torch::where(valid, w.expand_as(p), torch::zeros({}, w.options()));
    }
    weights = weights * w;
  }
  loss = loss * weights;
  switch (reduction) {
    case Reduction::kNone:
      return loss;
    case Reduction::kSum:
      return loss.sum();
    case Reduction::kMean:
      break;
  }
  const auto total = weights.expand_as(loss).sum();
  return loss.sum() / torch::where(total > 0, total, torch::ones_like(total));
}

Tensor UncertaintyLoss::uncertainty(const Tensor& raw) const { return g_.value(parametrization_.value(widen(raw))); }

Tensor UncertaintyLoss::expected_error(const Tensor& raw) const {
  const auto x = widen(raw).detach().clamp_min(kRawMin).to(torch::kFloat64);
  return (-config_.lam * derivative(g_, x) / derivative(h_, x)).to(widen(raw).scalar_type());
}

std::string UncertaintyLoss::describe() const {
  std::ostringstream text;
  text << "f=" << term_text(f_.name, f_.params) << " h=" << term_text(h_.name, h_.params)
       << " g=" << term_text(g_.name, g_.params) << " lam=" << config_.lam
       << " parametrization=" << term_text(parametrization_.name, parametrization_.params);
  return text.str();
}

}  // namespace ajna::loss
