// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <optional>
#include <string>
#include <utility>

#include "ajna/loss/uncertainty_loss.hpp"

namespace ajna::loss {

/// The error distribution that a loss is the negative log-likelihood of (paper Eq. 13), where it is one.
///
/// exp(-h f) integrates to a multiple of h^(-d/p) for f = |error|^p over d dimensions; loss = factor * NLL + constant
/// holds where lam g = -(factor d/p) log h + constant. With factor 1, exp(-loss) itself is the normalised density; any
/// other positive factor only scales the loss, so training still is maximum likelihood and the density is known.
class Likelihood {
 public:
  enum class Family {
    kLaplace,   ///< f = l1, or l2 of one channel: scale b = factor / h
    kGaussian,  ///< f = squared_error or squared_l2: variance = factor / (2 h)
    kAngular,   ///< f = angular in three dimensions: density exp(-angle h / factor) on the sphere
    kRadial,    ///< f = l2 of d > 1 channels: density exp(-|error| / b) in d dimensions, b = factor / h
  };

  /// The likelihood behind a loss, or nothing. channels: d for the terms over the channel axis (l2, squared_l2).
  static std::optional<Likelihood> of(const UncertaintyLoss& loss, std::int64_t channels = 1);
  /// Likewise, but throws Error(kInvalidArgument) with what is missing.
  static Likelihood require(const UncertaintyLoss& loss, std::int64_t channels = 1);

  [[nodiscard]] Family family() const noexcept { return family_; }
  [[nodiscard]] std::string name() const;  ///< "Laplace", "Gaussian", "angular von Mises-Fisher", "spherical Laplace"
  [[nodiscard]] double factor() const noexcept { return factor_; }
  [[nodiscard]] bool is_normalised() const;  ///< factor is 1

  /// Laplace, spherical Laplace: b; Gaussian: sigma; angular: the concentration. Same shape as raw.
  [[nodiscard]] torch::Tensor scale(const torch::Tensor& raw) const;
  /// -log p(target | prediction, raw) in nats: the shape of f's value (for l2 and squared_l2 over all channels
  /// together).
  [[nodiscard]] torch::Tensor nll(const torch::Tensor& prediction, const torch::Tensor& raw,
                                  const torch::Tensor& target) const;
  /// The continuous ranked probability score, the integral of (cdf(x) - [x >= error])^2 over x, per component: shape of
  /// the prediction and its unit; lower is better, for a point forecast the absolute error. Closed forms for Laplace
  /// and Gaussian (for squared_l2 of the components' own distributions); throws Error(kInvalidArgument) for the others,
  /// whose components have no such form.
  [[nodiscard]] torch::Tensor crps(const torch::Tensor& prediction, const torch::Tensor& raw,
                                   const torch::Tensor& target) const;
  /// P(error <= x), error = target - prediction per component (for squared_l2 each component has the same); for the
  /// angular family the angle in radians, for the radial family the length |error| over all channels.
  [[nodiscard]] torch::Tensor cdf(const torch::Tensor& x, const torch::Tensor& raw) const;
  /// The x with cdf(x) = p, 0 < p < 1; p broadcasts with raw.
  [[nodiscard]] torch::Tensor quantile(const torch::Tensor& p, const torch::Tensor& raw) const;
  /// The central interval that holds a share p of the errors (from 0 for angle and length): low, high.
  [[nodiscard]] std::pair<torch::Tensor, torch::Tensor> interval(double p, const torch::Tensor& raw) const;
  /// One error (angle, length) per element of raw, from torch's generator of raw's device.
  [[nodiscard]] torch::Tensor sample(const torch::Tensor& raw) const;

 private:
  Likelihood(const UncertaintyLoss& loss, Family family, double factor, std::int64_t channels)
      : loss_(loss), family_(family), factor_(factor), channels_(channels) {}

  UncertaintyLoss loss_;
  Family family_;
  double factor_;
  std::int64_t channels_;
};

}  // namespace ajna::loss
