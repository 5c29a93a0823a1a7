// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

namespace ajna::nn {

/// What the network's raw uncertainty means, sampled from the loss it was trained with, so that whoever runs the
/// network needs no loss code. Piecewise linear in raw: below the first knot the first value, above the last knot
/// a straight continuation by the last slope; NaN stays NaN.
struct UncertaintyTable {
  double raw_min = 0.0;   ///< raw at the first knot
  double raw_step = 0.0;  ///< distance of the knots, > 0
  /// [K] float32, not decreasing: g(raw), in the unit of the loss.
  torch::Tensor uncertainty;
  /// [K] float32, not decreasing, >= 0: the error expected at this raw, as a length in training units
  /// (pixels / flow_scale). For a squared f this is the root of kappa.
  torch::Tensor expected_error;

  struct Values {
    torch::Tensor uncertainty, expected_error;
  };
  /// Both at `raw` (any shape, floating point): float32 of raw's shape, on raw's device, which must be the table's.
  [[nodiscard]] Values evaluate(const torch::Tensor& raw) const;
  /// The same table with its tensors on `device`.
  [[nodiscard]] UncertaintyTable to(torch::Device device) const;
  /// Throws Error(kInvalidArgument) where a field breaks what is stated above. K is 2 to 2^20.
  void check() const;
};

}  // namespace ajna::nn
