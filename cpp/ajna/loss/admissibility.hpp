// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <optional>
#include <string>

#include "ajna/loss/uncertainty_loss.hpp"

namespace ajna::loss {

/// Whether minimising a loss makes raw a measure of the expected error, over a domain of raw.
struct AdmissibilityReport {
  bool admissible = false;
  double raw_min = 0.0, raw_max = 0.0;
  std::optional<double> fails_at;           ///< the lowest raw at which a condition fails
  std::string reason;                       ///< one sentence; empty where admissible
  double error_min = 0.0, error_max = 0.0;  ///< kappa at the ends: the expected errors that raw can express
};

/// At the optimum kappa(raw) = -lambda g'/h' is the expected f: that point is the unique
/// minimum, and raw rises with the expected error, exactly where h' < 0 and kappa is positive and strictly increasing;
/// h > 0 in addition, or the loss would push predictions away from their targets. Sampled at 4737 points in float64.
/// The ends default to UncertaintyLoss::kRawMin and kOwnRawMax. Throws Error(kInvalidArgument) for an empty domain.
AdmissibilityReport check(const UncertaintyLoss& loss, double raw_min = UncertaintyLoss::kRawMin,
                          double raw_max = UncertaintyLoss::kOwnRawMax);

}  // namespace ajna::loss
