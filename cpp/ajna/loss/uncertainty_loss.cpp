// SPDX-License-Identifier: MIT
#include "ajna/loss/uncertainty_loss.hpp"

#include <cmath>
#include <limits>
#include <sstream>
#include <tuple>

#include "ajna/base/error.hpp"
#include "ajna/loss/derivative.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

/// float16 -> float32, and back with gradients that saturate: an infinite one would spoil the whole network.
class WidenHalf : public torch::autograd::Function<WidenHalf> {
 public:
  static Tensor forward(torch::autograd::AutogradContext*, const Tensor& x) { return x.to(torch::kFloat32); }
  static torch::autograd::tensor_list backward(torch::autograd::AutogradContext*,
                                               const torch::autograd::tensor_list& grads) {
    constexpr double kHalfMax = 65504.0;
    const auto& grad = grads[0];
    // Only what is finite: an Inf or NaN that came from elsewhere must stay visible.
    const auto saturated = torch::where(grad.isfinite(), grad.clamp(-kHalfMax, kHalfMax), grad);
    return {saturated.to(torch::kHalf)};
  }
};

/// Half precision is too narrow for h: compute in float32 there, in the given precision otherwise.
Tensor widen(const Tensor& x) {
  if (x.scalar_type() == torch::kHalf && x.requires_grad() && at::GradMode::is_enabled()) {
    return WidenHalf::apply(x);
  }
  return x.scalar_type() == torch::kHalf || x.scalar_type() == torch::kBFloat16 ? x.to(torch::kFloat32) : x;
}

std::string shape_text(const Tensor& x) { return c10::str(x.sizes()); }

constexpr const char* kPredictionShapes = "give [N, 1, H, W], [N, H, W] or the prediction's shape";

/// Raw, masks and weights may come as [N, H, W] beside [N, C, H, W] predictions.
Tensor match_dims(const Tensor& x, const Tensor& like, const char* what, const char* remedy) {
  Tensor result = x.dim() == like.dim() - 1 && like.dim() >= 2 ? x.unsqueeze(1) : x;
  bool fits = result.dim() == like.dim();
  for (std::int64_t d = 0; fits && d < like.dim(); ++d) {
    fits = result.size(d) == like.size(d) || result.size(d) == 1;
  }
  if (!fits) {
    throw_invalid(std::string(what) + " of shape " + shape_text(x) + " does not fit a prediction of shape " +
                  shape_text(like) + ": " + remedy);
  }
  return result;
}

/// f's value has the prediction's shape, or one channel in place of its C.
void check_error_shape(const Tensor& error, const Tensor& p, const std::string& name) {
  bool fits = error.defined() && error.dim() == p.dim();
  for (std::int64_t d = 0; fits && d < p.dim(); ++d) {
    fits = error.size(d) == p.size(d) || (d == 1 && error.size(d) == 1);
  }
  if (!fits) {
    throw_invalid("loss term f = '" + name + "' gives shape " + (error.defined() ? shape_text(error) : "'none'") +
                  " for a prediction of shape " + shape_text(p) + ": return the prediction's shape or one channel");
  }
}

/// Class indices [N, ...] or [N, 1, ...] -> [N, C, ...] of 0 and 1 in the logits' precision.
Tensor one_hot(const Tensor& target, const Tensor& logits, const std::optional<Tensor>& mask) {
  if (logits.dim() < 2) {
    throw_invalid("logits of shape " + shape_text(logits) + " have no class axis: give [N, C, ...]");
  }
  const auto slot = logits.narrow(1, 0, 1);
  auto index = match_dims(target.to(torch::kLong), slot, "class target", "give class indices [N, ...] or [N, 1, ...]");
  if (index.sizes() != slot.sizes()) {
    throw_invalid("class target of shape " + shape_text(target) + " does not fit logits of shape " +
                  shape_text(logits) + ": give class indices [N, ...] or [N, 1, ...]");
  }
  if (mask) {
    auto valid = match_dims(mask->to(torch::kBool), logits, "mask", kPredictionShapes).expand_as(logits);
    index = torch::where(valid.all(1, /*keepdim=*/true), index, torch::zeros_like(index));
  }
  if (index.numel() > 0) {
    const auto low = index.min().item<std::int64_t>(), high = index.max().item<std::int64_t>();
    if (low < 0 || high >= logits.size(1)) {
      throw_invalid("class " + std::to_string(low < 0 ? low : high) + " of the target is outside 0 to " +
                    std::to_string(logits.size(1) - 1) + ": mask such pixels or give more logits");
    }
  }
  return torch::zeros_like(logits.detach()).scatter_(1, index, 1.0);
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
  probe(h_, "loss term h");
  probe(g_, "loss term g");
  h_ends_ = continuation(h_, /*constant_above=*/true);
  g_ends_ = continuation(g_, /*constant_above=*/false);
}

bool UncertaintyLoss::is_own(const ScalarTerm& term) const {
  return term.origin != TermOrigin::kRegistered || parametrization_.origin != TermOrigin::kRegistered;
}

void UncertaintyLoss::probe(const ScalarTerm& term, const std::string& what) const {
  if (!is_own(term)) return;
  for (const auto dtype : {torch::kFloat64, torch::kFloat32}) {
    const auto raw = torch::linspace(kRawMin, kOwnRawMax, 297, torch::TensorOptions().dtype(dtype));  // 1/4 apart
    const auto value = detail::value_and_slope([&](const Tensor& x) { return term.value(parametrization_.value(x)); },
                                               raw, what + " = '" + term.name + "'");
    const auto bad = (value.first.isfinite() & value.second.isfinite()).logical_not().nonzero();
    if (bad.numel() == 0) continue;
    const auto at = raw[bad[0][0].item<std::int64_t>()];
    const auto a = parametrization_.value(at);
    throw_invalid(what + " = '" + term.name + "' or its derivative is not finite in " +
                  (dtype == torch::kFloat64 ? "float64" : "float32") + " at a = " + c10::str(a.item<double>()) +
                  " (raw = " + c10::str(at.item<double>()) +
                  "): change it, or choose a parametrization that keeps a in its domain, such as softplus");
  }
}

UncertaintyLoss::Continuation UncertaintyLoss::continuation(const ScalarTerm& term, bool constant_above) const {
  const auto slope_at = [&](double raw) {
    return detail::value_and_slope([&](const Tensor& x) { return term.value(parametrization_.value(x)); },
                                   torch::full({1}, raw, torch::kFloat64), term.name)
        .second.item<double>();
  };
  Continuation ends;
  ends.low_slope = slope_at(kRawMin);
  if (is_own(term)) {
    ends.above = true;
    ends.high = kOwnRawMax;
    // h must stay positive: its tangent would cross 0.
    ends.high_slope = constant_above ? 0.0 : slope_at(kOwnRawMax);
  }
  return ends;
}

Tensor UncertaintyLoss::evaluate(const ScalarTerm& term, const Continuation& ends, const Tensor& raw) const {
  // The tangent at kRawMin keeps value and gradient finite where h itself would overflow, and still pulls raw back.
  if (!ends.above) {
    return term.value(parametrization_.value(raw.clamp_min(kRawMin))) + ends.low_slope * (raw - kRawMin).clamp_max(0.0);
  }
  return term.value(parametrization_.value(raw.clamp(kRawMin, ends.high))) +
         ends.low_slope * (raw - kRawMin).clamp_max(0.0) + ends.high_slope * (raw - ends.high).clamp_min(0.0);
}

Tensor UncertaintyLoss::slope_in_a(const ScalarTerm& term, const Tensor& a) const {
  return term.slope ? term.slope(a) : detail::value_and_slope(term.value, a, term.name).second;
}

Tensor UncertaintyLoss::operator()(const Tensor& prediction, const Tensor& raw, const Tensor& target,
                                   const std::optional<Tensor>& mask, const std::optional<Tensor>& weight,
                                   Reduction reduction) const {
  auto p = widen(prediction);
  const bool classes =
      f_.name == "cross_entropy" && f_.origin == TermOrigin::kRegistered && !target.is_floating_point();
  auto t = classes ? one_hot(target, p, mask) : widen(target).to(p.scalar_type());
  if (p.sizes() != t.sizes()) {
    throw_invalid("prediction " + shape_text(p) + " and target " + shape_text(target) +
                  " differ in shape: give tensors of one shape");
  }
  Tensor valid;
  if (mask) {
    valid = match_dims(mask->to(torch::kBool), p, "mask", kPredictionShapes).expand_as(p);
    // Select before the arithmetic: 0 * NaN is NaN, so masking afterwards would not guard.
    const auto zero = torch::zeros({}, p.options());
    p = torch::where(valid, p, zero);
    t = torch::where(valid, t, zero);
  }
  const auto error = f_.value(p, t);
  check_error_shape(error, p, f_.name);
  if (valid.defined() && error.sizes() != p.sizes()) {
    valid = valid.all(1, /*keepdim=*/true);
  }
  auto r = match_dims(widen(raw), error, "raw uncertainty",
                      "give the shape of f's value, one channel for terms over the channel axis");
  if (valid.defined()) {
    // 1, not 0: 1/a and log(a) must be finite there, or 0 * Inf would come back as NaN.
    r = torch::where(valid, r.expand_as(error), torch::ones({}, r.options()));
  }
  auto loss = evaluate(h_, h_ends_, r) * error + config_.lam * evaluate(g_, g_ends_, r);
  auto weights = valid.defined() ? valid.to(loss.scalar_type()) : torch::ones({}, loss.options());
  if (weight) {
    auto w = match_dims(widen(*weight), error, "weight", kPredictionShapes).to(loss.scalar_type());
    if (valid.defined()) {
      w = torch::where(valid, w.expand_as(error), torch::zeros({}, w.options()));
    }
    weights = weights * w;
  }
  if (valid.defined()) {
    loss = torch::where(valid, loss, torch::zeros({}, loss.options()));  // f(0, 0) of an own term may be NaN
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

Tensor UncertaintyLoss::uncertainty(const Tensor& raw) const {
  constexpr double kLowest = -40.0;  // a = e^-40 still has a square in float32; below, log(a) would be -Inf
  const auto x = widen(raw).clamp_min(kLowest);
  if (!g_ends_.above) return g_.value(parametrization_.value(x));
  return g_.value(parametrization_.value(x.clamp(kRawMin, g_ends_.high))) +
         g_ends_.low_slope * (x - kRawMin).clamp_max(0.0) + g_ends_.high_slope * (x - g_ends_.high).clamp_min(0.0);
}

Tensor UncertaintyLoss::attenuation(const Tensor& raw) const { return evaluate(h_, h_ends_, widen(raw)); }

Tensor UncertaintyLoss::expected_error(const Tensor& raw) const {
  const auto wide = widen(raw.detach());
  const double high = is_own(h_) || is_own(g_) ? kOwnRawMax : std::numeric_limits<double>::infinity();
  const auto a = parametrization_.value(wide.clamp(kRawMin, high).to(torch::kFloat64)).detach();
  // The parametrization's own slope cancels.
  return (-config_.lam * slope_in_a(g_, a) / slope_in_a(h_, a)).to(wide.scalar_type());
}

LossCurves UncertaintyLoss::curves(const Tensor& raw) const {
  LossCurves curves;
  curves.raw = raw.detach().to(torch::kFloat64);
  const auto of = [&](const ScalarTerm& term) {
    return detail::value_and_slope([&](const Tensor& x) { return term.value(parametrization_.value(x)); }, curves.raw,
                                   term.name);
  };
  std::tie(curves.h, curves.h_slope) = of(h_);
  std::tie(curves.g, curves.g_slope) = of(g_);
  const auto a = parametrization_.value(curves.raw).detach();
  curves.kappa = -config_.lam * slope_in_a(g_, a) / slope_in_a(h_, a);
  return curves;
}

std::string UncertaintyLoss::describe() const {
  std::ostringstream text;
  text << "f=" << term_text(f_.name, f_.params) << " h=" << term_text(h_.name, h_.params)
       << " g=" << term_text(g_.name, g_.params) << " lam=" << config_.lam
       << " parametrization=" << term_text(parametrization_.name, parametrization_.params);
  return text.str();
}

}  // namespace ajna::loss
