// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace ajna::geometry {

/// What became of a robust fit; everything but kOk is a failure, and the numbers beside it mean nothing.
enum class FitStatus {
  kOk,
  kTooFewPoints,    ///< fewer matches than needed, or too few of them move
  kNoConsensus,     ///< no model agrees with enough of the matches
  kIllConditioned,  ///< the matches agree, but do not fix the answer (parallel motion: the focus is at infinity)
};
const char* to_string(FitStatus status) noexcept;

struct FitOptions {
  double inlier_px = 0.5;           ///< a match whose end is off by less than this counts as inlier
  double min_motion_px = 1.0;       ///< matches that move less say nothing of a direction (focus only)
  int min_inliers = 6;              ///< fewer inliers are a failure
  double min_inlier_ratio = 0.4;    ///< as is a smaller share of the usable matches
  double max_uncertainty_px = 100;  ///< standard deviation of the focus beyond which the fit is ill-conditioned
  int trials = 64;                  ///< random minimal samples
  int refinements = 8;              ///< rounds of reweighted least squares
  std::uint32_t seed = 1;           ///< of the samples: equal seed, equal answer
};

/// The focus of expansion: the point that all motion of a translating camera leads away from (or, flying backwards,
/// towards), whatever the depths.
struct FocusOfExpansion {
  FitStatus status = FitStatus::kTooFewPoints;
  Eigen::Vector2d point_px = Eigen::Vector2d::Zero();
  Eigen::Matrix2d covariance_px2 = Eigen::Matrix2d::Zero();  ///< of point_px, from the inliers' residuals
  int inliers = 0;
  std::vector<bool> is_inlier;  ///< per match
};

/// Robust least squares over the lines of motion: the point nearest to all lines through begin[i] and end[i]; samples
/// of two lines find the consensus, reweighted (Tukey) least squares refines it. Throws Error(kInvalidArgument) for
/// unequal lengths and values that are not finite.
FocusOfExpansion focus_of_expansion(const std::vector<Eigen::Vector2d>& begin, const std::vector<Eigen::Vector2d>& end,
                                    const FitOptions& options = {});

/// The image motion of a near-planar region that faces the camera: end = begin + rate * (end - focus), which is
/// [end, -1] (rate, rate * focus)' = end - begin, per axis with one common rate. Without approach the rate is 0 and
/// `shift_px` alone remains: the form has no singularity there.
struct Expansion {
  FitStatus status = FitStatus::kTooFewPoints;
  double rate = 0.0;                                   ///< 1 - 1 / magnification; positive: nearer
  Eigen::Vector2d shift_px = Eigen::Vector2d::Zero();  ///< rate * focus
  double rate_sigma = 0.0;                             ///< standard deviation of rate, from the inliers' residuals
  int inliers = 0;
  std::vector<bool> is_inlier;  ///< per match

  /// Where a point of the region goes.
  [[nodiscard]] Eigen::Vector2d apply(const Eigen::Vector2d& begin) const { return (begin - shift_px) / (1.0 - rate); }
  /// end size / begin size.
  [[nodiscard]] double magnification() const { return 1.0 / (1.0 - rate); }
  /// Whether the rate differs from 0 by more than three standard deviations, so that focus_px() means something.
  [[nodiscard]] bool has_focus() const;
  [[nodiscard]] Eigen::Vector2d focus_px() const { return shift_px / rate; }
};

/// Fit by samples of two matches and reweighted (Tukey) least squares. Throws as focus_of_expansion.
Expansion fit_expansion(const std::vector<Eigen::Vector2d>& begin, const std::vector<Eigen::Vector2d>& end,
                        const FitOptions& options = {});

/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const FitOptions& options);

}  // namespace ajna::geometry
