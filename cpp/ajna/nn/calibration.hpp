// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <map>
#include <string>
#include <vector>

#include "ajna/base/conformal.hpp"
#include "ajna/nn/uncertainty_table.hpp"

namespace ajna::nn {

/// What calibration adds to a checkpoint beside the new `expected_error` curve of its table.
struct Calibration {
  ConformalFactors factors;
  /// How it came about: free text, of which "data", "images", "pixels" and "date" must be there.
  std::map<std::string, std::string> provenance;

  /// Throws Error(kInvalidArgument) where the factors are out of range or a provenance is missing.
  void check() const;
};

/// How the pixels of several images count together.
enum class PixelWeighting {
  kImage,  ///< each image alike, its pixels sharing its weight: neighbouring pixels are no independent samples
  kPixel,  ///< each pixel alike, so that large and densely labelled images count more
};
/// Smallest share of the whole weight in each group of ExpectedErrorFit.
inline constexpr double kMinGroupShare = 1.0 / 256;

/// "image" or "pixel"; throws Error(kInvalidArgument) with the nearest name otherwise.
PixelWeighting parse_pixel_weighting(const std::string& name);

/// Weighted isotonic regression by pool-adjacent-violators (Ayer et al., 1955): the not decreasing sequence nearest to
/// `values` in weighted squares. values, weights > 0: float64 [K], finite. Returns float64 [K].
torch::Tensor isotonic_regression(const torch::Tensor& values, const torch::Tensor& weights);

/// Fits the `expected_error` curve of a table: the mean absolute error per axis as a monotone function of raw.
///
/// Memory does not grow: errors are summed in bins, one per knot of the table. The fit merges neighbouring knots until
/// each group holds a share of the weight, regresses the groups' means isotonically, and joins the centres of the
/// resulting blocks by straight lines (centred isotonic regression, Oron and Flournoy, 2017). Below the first centre
/// the curve stays at its value, so that no error smaller than those seen is promised; above the last one it follows
/// the shape of the old curve, scaled to meet it.
class ExpectedErrorFit {
 public:
  /// `table` as the network was trained or calibrated with; flow_scale: network output x flow_scale = pixels.
  /// min_share: of the whole weight, in each group.
  ExpectedErrorFit(UncertaintyTable table, double flow_scale, PixelWeighting weighting = PixelWeighting::kImage,
                   double min_share = kMinGroupShare);

  /// Add one image: raw [2, H, W], error = truth - flow [2, H, W] in pixels, valid bool [H, W]; on one device.
  /// What is not valid may hold NaN. An image without valid pixels does not count.
  /// Throws Error(kInvalidArgument) for other shapes and for values in valid pixels that are not finite.
  void add(const torch::Tensor& raw, const torch::Tensor& error, const torch::Tensor& valid);
  /// The table with the fitted curve. Throws Error(kInvalidArgument) before any image was added.
  [[nodiscard]] UncertaintyTable table() const;
  [[nodiscard]] std::int64_t images() const noexcept { return images_; }  ///< that counted
  [[nodiscard]] std::int64_t pixels() const noexcept { return pixels_; }  ///< that counted

 private:
  UncertaintyTable table_;
  double flow_scale_;
  PixelWeighting weighting_;
  double min_share_;
  torch::Tensor weight_, error_;  // float64 [knots], sums
  std::int64_t images_ = 0, pixels_ = 0;
};

/// Split-conformal quantiles of the score |error| / expected_error, per axis (Lei et al., 2018; for the weights per
/// image: Lee, Barber and Willett, 2023).
///
/// With kImage the n images are the units. If they and a new image are exchangeable, the interval with factor at(p)
/// holds the true flow of a random pixel of the new image with probability >= p: the factor is the smallest that covers
/// at least (n + 1) p / n of the mean image, for one pixel per image the score of rank ceil((n + 1) p). That holds on
/// average over images and pixels, not for each image, region or magnitude of motion, and not for images of another
/// kind. With kPixel the same would hold if all pixels were exchangeable, which the pixels of an image are not.
///
/// Memory does not grow: scores are counted in bins 0.5 % wide, and a quantile is the upper edge of its bin, on the
/// safe side. The scores' images must be others than those that the expected errors were fitted on.
class ConformalFit {
 public:
  explicit ConformalFit(PixelWeighting weighting = PixelWeighting::kImage);

  /// Add one image: expected_error, error [2, H, W] in pixels, valid bool [H, W]; as ExpectedErrorFit::add.
  void add(const torch::Tensor& expected_error, const torch::Tensor& error, const torch::Tensor& valid);
  /// Whether a finite factor exists at share p: with n units it must not exceed n / (n + 1).
  [[nodiscard]] bool reaches(double p) const;
  /// The factors at these shares. Throws Error(kInvalidArgument) for shares that are not rising inside (0, 1), and
  /// where one of them is not reached, with the number of images that it takes.
  [[nodiscard]] ConformalFactors factors(const std::vector<double>& levels) const;
  [[nodiscard]] std::int64_t images() const noexcept { return images_; }  ///< that counted
  [[nodiscard]] std::int64_t pixels() const noexcept { return pixels_; }  ///< that counted

 private:
  [[nodiscard]] std::int64_t units() const;
  PixelWeighting weighting_;
  torch::Tensor weight_;  // float64 [2, bins]: share of each axis' scores per bin, summed over units
  std::int64_t images_ = 0, pixels_ = 0;
};

}  // namespace ajna::nn
