// SPDX-License-Identifier: MIT
#include "ajna/loss/registry.hpp"

namespace ajna::loss::registry {
namespace {

using torch::Tensor;
constexpr double kPi = 3.14159265358979323846;
/// Above it exp is continued by its tangent: e^30 = 1e13 still has a square and a reciprocal in float32.
constexpr double kExpMax = 30.0;
constexpr double kMaxScale = 2.0;  // a = e^(scale raw) at the lowest raw, -10, still has a cube in float32

Entry<Scalar> plain(ScalarFunction value, ScalarFunction slope) {
  return {{}, [value = std::move(value), slope = std::move(slope)](const TermParams&) { return Scalar{value, slope}; }};
}

Tensor exp_with_tangent(const Tensor& x) {
  return x.clamp_max(kExpMax).exp() + std::exp(kExpMax) * (x - kExpMax).clamp_min(0.0);
}
Tensor exp_with_tangent_slope(const Tensor& x) { return x.clamp_max(kExpMax).exp(); }

/// Normaliser of exp(-c angle) on the sphere, c = 1 / a: the angular von Mises-Fisher distribution's g.
Tensor angular_vmf(const Tensor& a) {
  const auto c = a.reciprocal();
  return torch::log1p((-kPi * c).exp()) - torch::log1p(c.square());
}
Tensor angular_vmf_slope(const Tensor& a) {
  const auto c = a.reciprocal();
  return c.square() * (2.0 * c / (c.square() + 1.0) + kPi * torch::sigmoid(-kPi * c));
}

}  // namespace

const Registry<Scalar>& attenuations() {
  static const Registry<Scalar> entries = {
      // Paper Eq. 1: 1 / log(1 + e^(a + eps)); note that eps sits inside the exponent.
      {"inv_softplus",
       {{{"eps", 1e-3}},
        [](const TermParams& params) {
          const double eps = params.at("eps");
          return Scalar{[eps](const Tensor& a) { return torch::softplus(a + eps).reciprocal(); },
                        [eps](const Tensor& a) {
                          return -torch::sigmoid(a + eps) * torch::softplus(a + eps).reciprocal().square();
                        }};
        }}},
      {"inv_softplus_square", plain([](const Tensor& a) { return torch::softplus(a.square()).reciprocal(); },
                                    [](const Tensor& a) {
                                      const auto square = a.square();
                                      return -2.0 * a * torch::sigmoid(square) *
                                             torch::softplus(square).reciprocal().square();
                                    })},
      {"inv",
       plain([](const Tensor& a) { return a.reciprocal(); }, [](const Tensor& a) { return -a.reciprocal().square(); })},
      {"inv_square", plain([](const Tensor& a) { return a.square().reciprocal(); },
                           [](const Tensor& a) { return -2.0 * a.reciprocal().pow(3); })},
      {"exp_neg", plain([](const Tensor& a) { return (-a).exp(); }, [](const Tensor& a) { return -(-a).exp(); })},
      {"identity", plain([](const Tensor& a) { return a; }, [](const Tensor& a) { return torch::ones_like(a); })},
      {"neg", plain([](const Tensor& a) { return -a; }, [](const Tensor& a) { return -torch::ones_like(a); })},
      // No attenuation; a * 0 keeps the result in the caller's graph.
      {"one",
       plain([](const Tensor& a) { return a * 0.0 + 1.0; }, [](const Tensor& a) { return torch::zeros_like(a); })},
  };
  return entries;
}

const Registry<Scalar>& penalties() {
  static const Registry<Scalar> entries = {
      {"softplus",
       plain([](const Tensor& a) { return torch::softplus(a); }, [](const Tensor& a) { return torch::sigmoid(a); })},
      {"log", plain([](const Tensor& a) { return a.log(); }, [](const Tensor& a) { return a.reciprocal(); })},
      {"log_square",
       plain([](const Tensor& a) { return a.square().log(); }, [](const Tensor& a) { return 2.0 * a.reciprocal(); })},
      {"neg_log", plain([](const Tensor& a) { return -a.log(); }, [](const Tensor& a) { return -a.reciprocal(); })},
      {"identity", plain([](const Tensor& a) { return a; }, [](const Tensor& a) { return torch::ones_like(a); })},
      {"square", plain([](const Tensor& a) { return a.square(); }, [](const Tensor& a) { return 2.0 * a; })},
      {"angular_vmf", plain(angular_vmf, angular_vmf_slope)},
      // Table 3 prints log((1 + e^(a^2)) / (1 + a^2)).
      {"angular_printed",
       plain([](const Tensor& a) { return torch::softplus(a.square()) - torch::log1p(a.square()); },
             [](const Tensor& a) { return 2.0 * a * torch::sigmoid(a.square()) - 2.0 * a / (1.0 + a.square()); })},
  };
  return entries;
}

const Registry<Scalar>& parametrizations() {
  static const Registry<Scalar> entries = {
      {"none", plain([](const Tensor& raw) { return raw; }, [](const Tensor& raw) { return torch::ones_like(raw); })},
      {"softplus", plain([](const Tensor& raw) { return torch::softplus(raw); },
                         [](const Tensor& raw) { return torch::sigmoid(raw); })},
      // scale 0.5 makes raw a log variance where a is a standard deviation.
      {"exp",
       {{{"scale", 1.0}},
        [](const TermParams& params) {
          const double scale = positive(params, "scale", "parametrization 'exp'");
          if (scale > kMaxScale) {
            throw_invalid("parameter 'scale' of parametrization 'exp' is " + c10::str(scale) + ": give at most 2");
          }
          return Scalar{
              [scale](const Tensor& raw) { return exp_with_tangent(scale * raw); },
              [scale](const Tensor& raw) { return scale * exp_with_tangent_slope(scale * raw); },
          };
        }}},
      // 1 / (1 + e^raw): a confidence in (0, 1) that falls as raw, and with it the uncertainty, rises.
      {"confidence", plain([](const Tensor& raw) { return (1.0 + exp_with_tangent(raw)).reciprocal(); },
                           [](const Tensor& raw) {
                             return -exp_with_tangent_slope(raw) * (1.0 + exp_with_tangent(raw)).reciprocal().square();
                           })},
  };
  return entries;
}

}  // namespace ajna::loss::registry
