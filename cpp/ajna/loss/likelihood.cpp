// SPDX-License-Identifier: MIT
#include "ajna/loss/likelihood.hpp"

#include <cmath>

#include "ajna/base/error.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;
constexpr double kPi = 3.14159265358979323846;
constexpr double kTolerance = 1e-6;

struct Power {
  Likelihood::Family family;
  double exponent;   // f = |error|^exponent
  double dimension;  // d of one value of f
};

std::optional<Power> power_of(const std::string& f, std::int64_t channels) {
  using Family = Likelihood::Family;
  const auto d = static_cast<double>(channels);
  if (f == "l1") return Power{Family::kLaplace, 1.0, 1.0};
  if (f == "l2" && channels == 1) return Power{Family::kLaplace, 1.0, 1.0};
  if (f == "l2") return Power{Family::kRadial, 1.0, d};
  if (f == "squared_error") return Power{Family::kGaussian, 2.0, 1.0};
  if (f == "squared_l2") return Power{Family::kGaussian, 2.0, d};
  return std::nullopt;
}

/// The factor by which y is a straight line in x, or nothing.
std::optional<double> proportion(const Tensor& x, const Tensor& y) {
  if (!x.isfinite().all().item<bool>() || !y.isfinite().all().item<bool>()) return std::nullopt;
  const auto dx = x - x.mean(), dy = y - y.mean();
  const double spread = dx.square().sum().item<double>();
  if (spread <= 0.0) return std::nullopt;
  const double slope = (dx * dy).sum().item<double>() / spread;
  const double miss = (dy - slope * dx).abs().max().item<double>();
  const double range = (y.max() - y.min()).item<double>();
  if (slope <= 0.0 || miss > kTolerance * range) return std::nullopt;
  return std::abs(slope - 1.0) < kTolerance ? 1.0 : slope;
}

/// log of 2 pi times the integral of exp(-c angle) over the sphere: the angular density's normaliser.
Tensor log_normaliser(const Tensor& c) {
  return std::log(2.0 * kPi) + torch::log1p((-kPi * c).exp()) - torch::log1p(c.square());
}

Tensor angular_cdf(const Tensor& x, const Tensor& c) {
  const auto angle = x.clamp(0.0, kPi);
  return (1.0 - (-c * angle).exp() * (c * angle.sin() + angle.cos())) / (1.0 + (-kPi * c).exp());
}

/// P(length <= x) of a spherical Laplace distribution: the length is Gamma distributed with shape d.
Tensor radial_cdf(const Tensor& x, const Tensor& b, double d) {
  const auto ratio = (x / b).clamp_min(0.0);
  return torch::special_gammainc(torch::full_like(ratio, d), ratio);
}

/// Where the rising `cdf` passes `share`, by halving [0, high].
template <typename Cdf>
Tensor invert(const Cdf& cdf, const Tensor& share, Tensor high) {
  auto low = torch::zeros_like(high);
  constexpr int kHalvings = 60;  // high / 2^60 is below float64's resolution
  for (int i = 0; i < kHalvings; ++i) {
    const auto middle = 0.5 * (low + high);
    const auto below = cdf(middle) < share;
    low = torch::where(below, middle, low);
    high = torch::where(below, high, middle);
  }
  return 0.5 * (low + high);
}

void check_share(double low, double high) {
  if (!(low > 0.0 && high < 1.0)) {
    throw_invalid("probability " + c10::str(low > 0.0 ? high : low) + " is not inside (0, 1): give for example 0.9");
  }
}

}  // namespace

std::optional<Likelihood> Likelihood::of(const UncertaintyLoss& loss, std::int64_t channels) {
  if (channels < 1) {
    throw_invalid("channels = " + std::to_string(channels) + ": give 1 or more");
  }
  const auto& config = loss.config();
  if (config.f.error_function) return std::nullopt;
  const auto raw = torch::linspace(UncertaintyLoss::kRawMin, 20.0, 241, torch::TensorOptions().dtype(torch::kFloat64));
  const auto curves = loss.curves(raw);
  if (!(curves.h > 0).all().item<bool>()) return std::nullopt;
  const auto penalty = config.lam * curves.g;
  if (config.f.name == "angular") {
    const auto factor = proportion(log_normaliser(curves.h), penalty);
    // Another factor would have to appear inside the normaliser too.
    if (!factor || *factor != 1.0) return std::nullopt;
    return Likelihood(loss, Family::kAngular, 1.0, channels);
  }
  const auto power = power_of(config.f.name, channels);
  if (!power) return std::nullopt;
  const auto factor = proportion(-(power->dimension / power->exponent) * curves.h.log(), penalty);
  if (!factor) return std::nullopt;
  return Likelihood(loss, power->family, *factor, channels);
}

Likelihood Likelihood::require(const UncertaintyLoss& loss, std::int64_t channels) {
  auto found = of(loss, channels);
  if (!found) {
    throw_invalid("loss " + loss.describe() +
                  " is not the likelihood of a known distribution: lam g must be -(c d/p) log h for f = |error|^p, as "
                  "in f=l1 h=inv g=log or f=squared_error h=inv_square g=log_square");
  }
  return *found;
}

std::string Likelihood::name() const {
  switch (family_) {
    case Family::kLaplace:
      return "Laplace";
    case Family::kGaussian:
      return "Gaussian";
    case Family::kRadial:
      return "spherical Laplace";
    case Family::kAngular:
      break;
  }
  return "angular von Mises-Fisher";
}

bool Likelihood::is_normalised() const { return factor_ == 1.0; }

Tensor Likelihood::scale(const Tensor& raw) const {
  auto h = loss_.attenuation(raw);
  switch (family_) {
    case Family::kLaplace:
    case Family::kRadial:
      return factor_ / h;
    case Family::kGaussian:
      return (0.5 * factor_ / h).sqrt();
    case Family::kAngular:
      break;
  }
  return h;
}

Tensor Likelihood::nll(const Tensor& prediction, const Tensor& raw, const Tensor& target) const {
  if (prediction.sizes() != target.sizes()) {
    throw_invalid("prediction " + c10::str(prediction.sizes()) + " and target " + c10::str(target.sizes()) +
                  " differ in shape: give tensors of one shape");
  }
  const auto s = scale(raw);
  const auto p = prediction.to(s.scalar_type()), t = target.to(s.scalar_type());
  const auto error = make_error_term(loss_.config().f).value(p, t);
  const bool joint = family_ == Family::kRadial || loss_.config().f.name == "squared_l2";
  const double d = joint ? static_cast<double>(p.size(1)) : 1.0;
  if (joint && p.size(1) != channels_) {
    throw_invalid("prediction has " + std::to_string(p.size(1)) + " channels, the likelihood was asked for " +
                  std::to_string(channels_) + ": pass channels=" + std::to_string(p.size(1)));
  }
  switch (family_) {
    case Family::kLaplace:
      return error / s + (2.0 * s).log();
    case Family::kGaussian:
      return 0.5 * error / s.square() + d * (s.log() + 0.5 * std::log(2.0 * kPi));
    case Family::kRadial:
      // The surface of the unit sphere, 2 pi^(d/2) / Gamma(d/2), times the integral of r^(d-1) exp(-r), Gamma(d).
      return error / s + d * s.log() + std::log(2.0) + 0.5 * d * std::log(kPi) - std::lgamma(0.5 * d) + std::lgamma(d);
    case Family::kAngular:
      break;
  }
  if (p.size(1) != 3) {
    throw_invalid("angular likelihood of " + std::to_string(p.size(1)) + " channels: it is for directions of 3");
  }
  return error * s + log_normaliser(s);
}

Tensor Likelihood::crps(const Tensor& prediction, const Tensor& raw, const Tensor& target) const {
  if (family_ == Family::kAngular || family_ == Family::kRadial) {
    throw_invalid("the CRPS of the " + name() + " distribution (f = " + loss_.config().f.name +
                  ") has no closed form per component: use its nll");
  }
  if (prediction.sizes() != target.sizes()) {
    throw_invalid("prediction " + c10::str(prediction.sizes()) + " and target " + c10::str(target.sizes()) +
                  " differ in shape: give tensors of one shape");
  }
  const auto s = scale(raw);
  const auto z = (target.to(s.scalar_type()) - prediction.to(s.scalar_type())).abs() / s;
  if (family_ == Family::kLaplace) {
    return s * (z + (-z).exp() - 0.75);
  }
  constexpr double kInverseSqrtPi = 0.5641895835477563;
  const auto density = (-0.5 * z.square()).exp() / std::sqrt(2.0 * kPi);
  return s * (z * (2.0 * torch::special_ndtr(z) - 1.0) + 2.0 * density - kInverseSqrtPi);
}

Tensor Likelihood::cdf(const Tensor& x, const Tensor& raw) const {
  const auto s = scale(raw);
  const auto value = x.to(s.options());
  switch (family_) {
    case Family::kLaplace: {
      const auto tail = 0.5 * (-value.abs() / s).exp();
      return torch::where(value > 0, 1.0 - tail, tail);
    }
    case Family::kGaussian:
      return torch::special_ndtr(value / s);
    case Family::kRadial:
      return radial_cdf(value, s, static_cast<double>(channels_));
    case Family::kAngular:
      break;
  }
  return angular_cdf(value, s);
}

Tensor Likelihood::quantile(const Tensor& p, const Tensor& raw) const {
  const auto s = scale(raw);
  const auto share = p.to(s.options());
  if (share.numel() > 0) {
    check_share(share.min().item<double>(), share.max().item<double>());
  }
  switch (family_) {
    case Family::kLaplace:
      return -s * (share - 0.5).sign() * torch::log1p(-2.0 * (share - 0.5).abs());
    case Family::kGaussian:
      return s * torch::special_ndtri(share);
    case Family::kRadial: {
      // Linear in b: invert once per share, at b = 1. The Gamma tail beyond the bound is below exp(-50).
      const torch::NoGradGuard no_grad;
      const double d = static_cast<double>(channels_);
      const auto one = torch::ones_like(share);
      return s * invert([&](const Tensor& x) { return radial_cdf(x, one, d); }, share, (10.0 * d + 100.0) * one);
    }
    case Family::kAngular:
      break;
  }
  const torch::NoGradGuard no_grad;
  return invert([&](const Tensor& x) { return angular_cdf(x, s); }, share, torch::full_like(share + s, kPi));
}

std::pair<Tensor, Tensor> Likelihood::interval(double p, const Tensor& raw) const {
  check_share(p, p);
  const auto at = [&](double share) { return quantile(torch::tensor(share, torch::kFloat64), raw); };
  if (family_ == Family::kAngular || family_ == Family::kRadial) {
    auto high = at(p);
    return {torch::zeros_like(high), high};
  }
  return {at(0.5 - 0.5 * p), at(0.5 + 0.5 * p)};
}

Tensor Likelihood::sample(const Tensor& raw) const {
  const torch::NoGradGuard no_grad;
  const auto s = scale(raw);
  if (family_ == Family::kGaussian) return s * torch::randn_like(s);
  // rand may give 0, at which no quantile exists.
  return quantile(torch::rand_like(s).clamp(1e-7, 1.0 - 1e-7), raw);
}

}  // namespace ajna::loss
