// SPDX-License-Identifier: MIT
#include "ajna/base/flow_field.hpp"

#include <algorithm>
#include <cmath>

#include "ajna/base/error.hpp"

namespace ajna {

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
  for (std::size_t i = 0; i < pixels; ++i) {
    const double magnitude = std::hypot(field.flow[2 * i], field.flow[2 * i + 1]);
    summary.mean_flow_px += magnitude;
    summary.max_flow_px = std::max(summary.max_flow_px, magnitude);
    summary.mean_uncertainty += std::hypot(field.uncertainty[2 * i], field.uncertainty[2 * i + 1]);
    summary.mean_expected_error_px += std::hypot(field.expected_error[2 * i], field.expected_error[2 * i + 1]);
  }
  summary.mean_flow_px /= static_cast<double>(pixels);
  summary.mean_uncertainty /= static_cast<double>(pixels);
  summary.mean_expected_error_px /= static_cast<double>(pixels);
  return summary;
}

}  // namespace ajna
