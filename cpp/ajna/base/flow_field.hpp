// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "ajna/base/conformal.hpp"

namespace ajna {

/// Between which two flows the true one lies; same layout as FlowField's planes.
struct FlowInterval {
  std::vector<float> low, high;  ///< pixels per frame interval
};

/// Dense optical flow and its uncertainty: the one seam between learning and robotics.
///
/// Sign, layout and units, defined here once: all planes are float32, height x width x 2, interleaved (u, v), on the
/// grid of frame 1; u points right, v down; flow is in pixels per frame interval, so that
/// frame1(x) ~ frame2(x + flow(x)).
struct FlowField {
  int width = 0;                      ///< pixels
  int height = 0;                     ///< pixels
  std::vector<float> flow;            ///< pixels per frame interval
  std::vector<float> uncertainty;     ///< g(raw) per axis: positive, monotone in the expected error, unit of the loss
  std::vector<float> expected_error;  ///< kappa(raw) per axis: the error that the network expects of itself, pixels
  double timestamp_s = 0.0;           ///< capture time of frame 2, seconds
  /// How far intervals reach; null where the model is not calibrated. Shared by all fields of a model.
  std::shared_ptr<const ConformalFactors> conformal;

  [[nodiscard]] std::size_t index(int x, int y) const noexcept {
    return 2 * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x));
  }

  /// Per axis the split-conformal interval that holds the true flow with probability `p`, over pixels of images like
  /// those that the model was calibrated on; linear between the calibrated levels.
  /// Throws Error(kInvalidArgument) where the model was not calibrated or not for such a p.
  [[nodiscard]] FlowInterval interval(double p) const;
};

/// The scalar map that tasks use: the 2-norm of `uncertainty` over the axes, height x width.
std::vector<float> uncertainty_norm(const FlowField& field);

/// Means over all pixels, for summaries.
struct FlowSummary {
  double mean_flow_px = 0.0;            ///< mean magnitude, pixels
  double max_flow_px = 0.0;             ///< largest magnitude, pixels
  double mean_uncertainty = 0.0;        ///< mean of uncertainty_norm
  double mean_expected_error_px = 0.0;  ///< mean 2-norm of expected_error, pixels
};
FlowSummary summarize(const FlowField& field);

}  // namespace ajna
