// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <vector>

#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {

struct GapDetectionOptions {
  MapOptions map;               ///< closing joins the rim and the inside of a gap
  double min_contrast = 1.25;   ///< mean inside over mean in a ring about the region, or the other way round
  bool certain = false;         ///< a region more certain than its ring may be a gap, too: what is seen through it is
                                ///< further away, and moves less than the wall; for pairs that are not aligned
  double ring = 0.25;           ///< width of that ring, as a share of the region's diameter
  double min_solidity = 0.55;   ///< region area over hull area: a gap is no scatter of branches
  double min_thickness = 0.25;  ///< inscribed over equal-area diameter: nor a line
  int retries = 1;  ///< where no gap is found: again with half the closing, which joins less with the border

  GapDetectionOptions();
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const GapDetectionOptions& options);

struct GapDetection {
  bool found = false;
  MapSteps steps;  ///< of the map, or of the map upside down where the gap is a certain region
  cv::Mat mask;    ///< CV_8U, 0 or 255: the gap
  std::vector<cv::Point2f> contour;
  Eigen::Vector2d safe_px = Eigen::Vector2d::Zero();  ///< median of the mask's pixels, per axis
  double contrast = 0.0;                              ///< against the ring, at least 1
  double score = 0.0;                                 ///< (contrast - 1) x square root of the area
  bool certain = false;                               ///< found as a region more certain than its ring
};

/// The gap in a (stacked) map: the region with the largest contrast to its ring, weighted by its size, that does not
/// touch the image's border. Nothing is found in maps that cannot be used.
GapDetection detect_gap(const cv::Mat& map, const GapDetectionOptions& options = {});

/// The median of the pixels inside a contour, per axis: the safe point; the contour's mean where it encloses nothing.
Eigen::Vector2d median_inside(const std::vector<cv::Point2f>& contour, const cv::Size& size);

}  // namespace ajna::tasks
