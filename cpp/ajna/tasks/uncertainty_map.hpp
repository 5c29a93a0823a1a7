// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "ajna/base/flow_field.hpp"

// From a map of uncertainty to regions: shared by all tasks. Every step keeps its intermediate, for pictures.

namespace ajna::tasks {

/// How the two axes of the uncertainty become one number.
enum class ScalarKind { kNorm, kMax, kX, kY };
/// Where "uncertain" begins, on the normalised map.
enum class ThresholdRule {
  kFixed,      ///< at MapOptions::fixed
  kQuantile,   ///< at the MapOptions::quantile of the pixels
  kOtsu,       ///< where the two classes differ most (Otsu)
  kMedianMad,  ///< median + mad_factor x median absolute deviation
};
enum class MapStatus {
  kOk,
  kFlat,          ///< nothing stands out: all-zero, all-equal, or a range below MapOptions::min_range
  kInvalidInput,  ///< empty, smaller than kMinSide, or with NaN, infinite or negative values
};
const char* to_string(ScalarKind kind) noexcept;
const char* to_string(ThresholdRule rule) noexcept;
const char* to_string(MapStatus status) noexcept;

constexpr int kMinSide = 8;  ///< pixels; smaller maps hold no region

struct MapOptions {
  ScalarKind scalar = ScalarKind::kNorm;
  double smooth_px = 1.5;  ///< standard deviation of the Gaussian; 0: none
  double background_px =
      0.0;            ///< side of the box whose mean is taken off first, so that slow variation is no edge; 0: none
  int border_px = 4;  ///< margin that counts as certain: there, motion leaves the image
  double low_quantile = 0.05;    ///< becomes 0 ...
  double high_quantile = 0.995;  ///< ... and this 1: what is beyond is clipped
  double min_range = 0.02;       ///< between the two, in units of the map; less is a flat map
  ThresholdRule rule = ThresholdRule::kOtsu;
  double fixed = 0.5;
  double quantile = 0.95;
  double mad_factor = 5.0;
  int open_px = 3;           ///< side of the opening ellipse; 0 or 1: none
  int close_px = 9;          ///< side of the closing rectangle, which joins the rims of one thing
  bool fill_holes = true;    ///< what is enclosed belongs to it
  double min_area = 0.0005;  ///< smallest region, as a share of the image
  double max_area = 0.5;     ///< largest
};

/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const MapOptions& options);

/// A connected region of a mask.
struct Region {
  int label = 0;  ///< its value in MapSteps::labels
  cv::Rect box;
  cv::Point2d centroid_px;
  double area_px = 0.0;
  double mean = 0.0;  ///< of the scalar map inside, in its units
  double peak = 0.0;
  double outside = 0.0;         ///< mean of the scalar map over the whole image without the regions
  bool touches_border = false;  ///< within the margin of border_px + 1
  /// How far it stands out: mean / outside; infinite above a map of zeros.
  [[nodiscard]] double contrast() const noexcept;
};

/// A map on its way to regions; what a failed status leaves out is empty.
struct MapSteps {
  MapStatus status = MapStatus::kInvalidInput;
  cv::Mat scalar;               ///< CV_32F, smoothed, units of the map
  cv::Mat normalized;           ///< CV_32F, 0 to 1
  double low = 0.0;             ///< value of scalar (less its background) that became 0
  double high = 0.0;            ///< and 1
  double threshold = 0.0;       ///< on normalized
  cv::Mat raw_mask;             ///< CV_8U, 0 or 255: above the threshold
  cv::Mat mask;                 ///< CV_8U: after morphology
  cv::Mat labels;               ///< CV_32S: components of mask, 0 is none
  std::vector<Region> regions;  ///< within the area limits, largest first
};

/// The scalar map of uncertainties per axis, CV_32FC2: CV_32F. Empty for any other type.
cv::Mat scalar_map(const cv::Mat& per_axis, ScalarKind kind = ScalarKind::kNorm);
/// The scalar map of a field: CV_32F, height x width. Empty for a field without uncertainty.
cv::Mat scalar_map(const FlowField& field, ScalarKind kind = ScalarKind::kNorm);
/// Whether a map can be worked on: CV_32F, sides of kMinSide at least, all values finite and not negative.
bool is_valid_map(const cv::Mat& map);
/// The threshold of a rule on a normalised map.
double threshold_of(const cv::Mat& normalized, const MapOptions& options);
/// Opening, closing, filling of a CV_8U mask.
cv::Mat morphology(const cv::Mat& mask, int open_px, int close_px, bool fill_holes);

/// Corners of the convex hull of the pixels of a CV_8U mask that are not 0; none for an empty one.
std::vector<cv::Point> convex_hull(const cv::Mat& mask);

/// All steps. Throws Error(kInvalidArgument) for options out of range; a map that cannot be used is a status.
/// counted: the part of the map, less the border, that sets normalisation and threshold; empty: all of it.
MapSteps find_regions(const cv::Mat& map, const MapOptions& options = {}, const cv::Rect& counted = {});

/// The largest connected space without uncertain pixels.
struct FreeSpace {
  bool found = false;
  cv::Point2d center_px;  ///< its centroid, or the deepest point where the centroid lies outside
  double area_px = 0.0;
  double clearance_px = 0.0;  ///< from center_px to the nearest uncertain pixel (or the window's edge)
  cv::Mat mask;               ///< CV_8U, whole image
};
/// unsafe: CV_8U, not 0 where uncertain; window: where to look, clipped to the image. The space that `before` lies in
/// counts as `keep` times its area, so that two of like size do not take turns.
FreeSpace largest_free_space(const cv::Mat& unsafe, const cv::Rect& window,
                             const std::optional<cv::Point2d>& before = std::nullopt, double keep = 1.0);

}  // namespace ajna::tasks
