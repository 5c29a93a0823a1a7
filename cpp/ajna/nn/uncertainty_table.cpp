// SPDX-License-Identifier: MIT
#include "ajna/nn/uncertainty_table.hpp"

#include <cmath>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

constexpr std::int64_t kMaxKnots = std::int64_t{1} << 20;

void check_curve(const torch::Tensor& curve, const std::string& name) {
  const std::string what = "uncertainty table '" + name + "'";
  if (!curve.defined() || curve.dim() != 1 || curve.scalar_type() != torch::kFloat32) {
    throw_invalid(what + " is " +
                  (curve.defined() ? c10::str(curve.sizes(), " ", c10::toString(curve.scalar_type())) : "missing") +
                  ": give one float32 value per knot");
  }
  if (curve.size(0) < 2 || curve.size(0) > kMaxKnots) {
    throw_invalid(what + " has " + std::to_string(curve.size(0)) + " knots: give 2 to " + std::to_string(kMaxKnots));
  }
  const auto values = curve.detach().to(torch::kCPU).contiguous();
  const float* y = values.const_data_ptr<float>();
  for (std::int64_t i = 0; i < values.size(0); ++i) {
    if (!std::isfinite(y[i])) {
      throw_invalid(what + " is " + std::to_string(y[i]) + " at knot " + std::to_string(i) +
                    ": every value must be finite; choose a narrower range of raw");
    }
    // The values were rounded to float32 from a derivative; a step back by rounding is no defect.
    if (i > 0 && y[i] < y[i - 1] - 1e-6F * std::abs(y[i - 1])) {
      throw_invalid(what + " falls from " + std::to_string(y[i - 1]) + " to " + std::to_string(y[i]) + " at knot " +
                    std::to_string(i) + ": it must not decrease with raw; choose an admissible loss");
    }
  }
}

}  // namespace

UncertaintyTable::Values UncertaintyTable::evaluate(const torch::Tensor& raw) const {
  const auto last_segment = static_cast<double>(uncertainty.size(0) - 2);
  const auto position = raw.to(torch::kFloat32).sub(raw_min).div(raw_step).clamp_min(0.0);
  // NaN has no knot: look it up at the first, and let the fraction carry it through.
  const auto segment = position.nan_to_num(0.0).clamp_max(last_segment).floor();
  const auto fraction = position.sub(segment);
  const auto knot = segment.to(torch::kInt64);
  const auto next = knot.add(1);
  const auto look_up = [&](const torch::Tensor& curve) {
    const auto value = torch::take(curve, knot);
    return torch::take(curve, next).sub(value).mul(fraction).add(value);
  };
  return {look_up(uncertainty), look_up(expected_error)};
}

UncertaintyTable UncertaintyTable::to(torch::Device device) const {
  return {raw_min, raw_step, uncertainty.to(device), expected_error.to(device)};
}

void UncertaintyTable::check() const {
  if (!std::isfinite(raw_min) || !std::isfinite(raw_step) || raw_step <= 0) {
    throw_invalid("uncertainty table starts at raw " + std::to_string(raw_min) + " in steps of " +
                  std::to_string(raw_step) + ": give finite numbers and a step above 0");
  }
  check_curve(uncertainty, "uncertainty");
  check_curve(expected_error, "expected_error");
  if (uncertainty.size(0) != expected_error.size(0)) {
    throw_invalid("uncertainty table has " + std::to_string(uncertainty.size(0)) + " and " +
                  std::to_string(expected_error.size(0)) + " knots: give both curves the same knots");
  }
  if (expected_error[0].item<float>() < 0) {
    throw_invalid("uncertainty table 'expected_error' starts at " + std::to_string(expected_error[0].item<float>()) +
                  ": an expected error is not negative");
  }
}

}  // namespace ajna::nn
