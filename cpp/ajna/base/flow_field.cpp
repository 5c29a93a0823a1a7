// SPDX-License-Identifier: MIT
#include "ajna/base/flow_field.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "ajna/base/error.hpp"

namespace ajna {
namespace {

struct Norms {
  double sum = 0.0;
  double largest = 0.0;
};

/// Of vectors (u, v) that lie one after another.
Norms norms_of(const std::vector<float>& vectors) {
  constexpr std::size_t kLanes = 8;  // sums that do not wait for each other
  std::array<double, kLanes> sum{};
  std::array<float, kLanes> largest{};
  const std::size_t count = vectors.size() / 2;
  for (std::size_t begin = 0; begin < count; begin += kLanes) {
    const std::size_t lanes = std::min(kLanes, count - begin);
    for (std::size_t k = 0; k < lanes; ++k) {
      const float u = vectors[2 * (begin + k)];
      const float v = vectors[2 * (begin + k) + 1];
      const float norm = std::sqrt(u * u + v * v);
      sum[k] += norm;
      largest[k] = std::max(largest[k], norm);
    }
  }
  return {std::accumulate(sum.begin(), sum.end(), 0.0), *std::max_element(largest.begin(), largest.end())};
}

}  // namespace

FlowInterval FlowField::interval(double p) const {
  if (conformal == nullptr) {
    throw_invalid(
        "flow intervals need a calibrated model: run `ajna calibrate MODEL --dataset NAME --root DIR --out "
        "NEW.safetensors` and load that file");
  }
  const auto factors = conformal->at(p);
  FlowInterval result;
  result.low.resize(flow.size());
  result.high.resize(flow.size());
  for (std::size_t i = 0; i < flow.size(); ++i) {
    const float reach = static_cast<float>(factors[i % 2]) * expected_error[i];
    result.low[i] = flow[i] - reach;
    result.high[i] = flow[i] + reach;
  }
  return result;
}

std::vector<float> uncertainty_norm(const FlowField& field) {
  std::vector<float> norm(field.uncertainty.size() / 2);
  for (std::size_t i = 0; i < norm.size(); ++i) {
    norm[i] = std::hypot(field.uncertainty[2 * i], field.uncertainty[2 * i + 1]);
  }
  return norm;
}

FlowSummary summarize(const FlowField& field) {
  FlowSummary summary;
  const std::size_t pixels = field.flow.size() / 2;
  if (pixels == 0) {
    return summary;
  }
  const Norms flow = norms_of(field.flow);
  const auto count = static_cast<double>(pixels);
  summary.mean_flow_px = flow.sum / count;
  summary.max_flow_px = flow.largest;
  summary.mean_uncertainty = norms_of(field.uncertainty).sum / count;
  summary.mean_expected_error_px = norms_of(field.expected_error).sum / count;
  return summary;
}

}  // namespace ajna
