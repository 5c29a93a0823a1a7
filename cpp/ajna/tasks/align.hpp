// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "ajna/base/image_view.hpp"

namespace ajna::tasks {

struct AlignOptions {
  int max_features = 200;
  double quality = 0.01;           ///< of corners, relative to the best
  double spacing_px = 7.0;         ///< between corners
  int window_px = 9;               ///< of the KLT tracker
  int levels = 4;                  ///< of its pyramid
  double max_roundtrip_px = 1.0;   ///< forward-backward check
  double inlier_px = 1.5;          ///< of the homography
  int min_inliers = 20;            ///< fewer, or ...
  double min_inlier_ratio = 0.25;  ///< ... a smaller share of what was tracked: nothing is common to both frames
  int margin_px = 6;               ///< along the edges of the aligned frame, which the network sees as boundaries
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const AlignOptions& options);

struct Alignment {
  bool found = false;  ///< false: the frame as it came
  int tracked = 0;
  int inliers = 0;
  cv::Matx33d reference_from_frame = cv::Matx33d::eye();  ///< homography, pixels
  cv::Mat image;                                          ///< CV_8UC3, RGB: the frame on the reference's grid
  cv::Mat valid;                                          ///< CV_8U, 0 or 255: where the frame has pixels for it
};

/// Takes the motion that most of the picture has in common out of a pair: the homography of most of the tracked
/// corners, which is that of the largest plane (a wall), or of a turning camera. What stands out of that plane still
/// moves in the aligned pair, little, before a background at rest: there a network is at its best. Throws
/// Error(kInvalidArgument) for views that are no RGB images of one size.
Alignment align_to(const ImageView& reference, const ImageView& frame, const AlignOptions& options = {});

/// Takes the camera's turning out of a pair, where an IMU knows it; what is left of the motion shows depth.
/// reference_from_frame: rotation that turns directions in the frame's camera axes (x right, y down, z forward) into
/// the reference's. Always found. Throws Error(kInvalidArgument) for a view that is no RGB image, a matrix that is no
/// rotation, or a field of view that is none.
Alignment derotate_frame(const ImageView& frame, const Eigen::Matrix3d& reference_from_frame, double horizontal_fov_rad,
                         const AlignOptions& options = {});

/// A copy of `map` in which nothing stands out where `valid` is 0: the median of the rest. map: CV_32F; valid: CV_8U.
/// The map as it is where the sizes differ or nothing is valid.
cv::Mat within(const cv::Mat& map, const cv::Mat& valid);

}  // namespace ajna::tasks
