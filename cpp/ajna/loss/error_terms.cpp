// SPDX-License-Identifier: MIT
#include "ajna/loss/registry.hpp"

namespace ajna::loss::registry {
namespace {

using torch::Tensor;

void need_channels(const Tensor& x, const char* name) {
  if (x.dim() < 2) {
    throw_invalid(std::string("loss term f '") + name + "' works over the channel axis, but the prediction has shape " +
                  c10::str(x.sizes()) + ": give [N, C, ...]");
  }
}

/// Euclidean norm over the channels; its gradient at 0 is 0, where a plain square root would give NaN.
Tensor channel_norm(const Tensor& x) { return torch::linalg_vector_norm(x, 2, {1}, /*keepdim=*/true); }

Tensor unit(const Tensor& x) {
  constexpr double kSmallest = 1e-6;  // below it there is no direction: the angle is then 90 degrees
  return x / channel_norm(x).clamp_min(kSmallest);
}

/// The angle between two vectors by Kahan's formula: acos of the dot product has an infinite slope at 0 and pi, where
/// rounding moves its argument out of [-1, 1]; this has neither fault.
Tensor angle(const Tensor& p, const Tensor& t) {
  need_channels(p, "angular");
  const auto u = unit(p), v = unit(t);
  return 2.0 * torch::atan2(channel_norm(u - v), channel_norm(u + v));
}

Tensor quadratic_then_linear(const Tensor& difference, double bend, double scale) {
  const auto size = difference.abs();
  return scale * torch::where(size < bend, 0.5 * size.square(), bend * (size - 0.5 * bend));
}

ErrorFunction difference_of(std::function<Tensor(const Tensor&)> function) {
  return [function = std::move(function)](const Tensor& p, const Tensor& t) { return function(p - t); };
}

}  // namespace

const Registry<ErrorFunction>& error_terms() {
  static const Registry<ErrorFunction> entries = {
      {"l1", {{}, [](const TermParams&) { return difference_of([](const Tensor& d) { return d.abs(); }); }}},
      {"l2",
       {{},
        [](const TermParams&) {
          return difference_of([](const Tensor& d) {
            need_channels(d, "l2");
            return channel_norm(d);
          });
        }}},
      {"squared_error",
       {{}, [](const TermParams&) { return difference_of([](const Tensor& d) { return d.square(); }); }}},
      {"squared_l2",
       {{},
        [](const TermParams&) {
          return difference_of([](const Tensor& d) {
            need_channels(d, "squared_l2");
            return d.square().sum(1, /*keepdim=*/true);
          });
        }}},
      {"smooth_l1",
       {{{"beta", 1.0}},
        [](const TermParams& params) {
          const double beta = positive(params, "beta", "loss term f 'smooth_l1'");
          return difference_of([beta](const Tensor& d) { return quadratic_then_linear(d, beta, 1.0 / beta); });
        }}},
      {"huber",
       {{{"delta", 1.0}},
        [](const TermParams& params) {
          const double delta = positive(params, "delta", "loss term f 'huber'");
          return difference_of([delta](const Tensor& d) { return quadratic_then_linear(d, delta, 1.0); });
        }}},
      {"charbonnier",
       {{{"eps", 1e-3}},
        [](const TermParams& params) {
          const double eps = params.at("eps");
          return difference_of([eps](const Tensor& d) { return (d.square() + eps * eps).sqrt() - eps; });
        }}},
      {"angular", {{}, [](const TermParams&) { return ErrorFunction(angle); }}},
      // Logits against class probabilities; UncertaintyLoss turns class indices into these.
      {"cross_entropy",
       {{},
        [](const TermParams&) {
          return ErrorFunction([](const Tensor& p, const Tensor& t) {
            need_channels(p, "cross_entropy");
            return -(t * torch::log_softmax(p, 1)).sum(1, /*keepdim=*/true);
          });
        }}},
  };
  return entries;
}

}  // namespace ajna::loss::registry
