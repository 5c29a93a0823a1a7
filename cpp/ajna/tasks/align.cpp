// SPDX-License-Identifier: MIT
#include "ajna/tasks/align.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/tasks/frame_mat.hpp"
#include "ajna/tasks/map_histogram.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {
namespace {

struct Matches {
  std::vector<cv::Point2f> reference;
  std::vector<cv::Point2f> frame;
};

/// Corners of the reference that are found in the frame, and back again.
Matches track(const cv::Mat& reference, const cv::Mat& frame, const AlignOptions& options) {
  Matches matches;
  std::vector<cv::Point2f> corners;
  cv::goodFeaturesToTrack(reference, corners, options.max_features, options.quality, options.spacing_px);
  if (corners.empty()) {
    return matches;
  }
  const cv::Size window(options.window_px, options.window_px);
  std::vector<cv::Mat> first;
  std::vector<cv::Mat> second;
  cv::buildOpticalFlowPyramid(reference, first, window, options.levels);
  cv::buildOpticalFlowPyramid(frame, second, window, options.levels);
  std::vector<cv::Point2f> there;
  std::vector<cv::Point2f> back;
  std::vector<std::uint8_t> ok_there;
  std::vector<std::uint8_t> ok_back;
  cv::calcOpticalFlowPyrLK(first, second, corners, there, ok_there, cv::noArray(), window, options.levels);
  cv::calcOpticalFlowPyrLK(second, first, there, back, ok_back, cv::noArray(), window, options.levels);
  for (std::size_t i = 0; i < corners.size(); ++i) {
    if (ok_there[i] != 0 && ok_back[i] != 0 && cv::norm(back[i] - corners[i]) < options.max_roundtrip_px) {
      matches.reference.push_back(corners[i]);
      matches.frame.push_back(there[i]);
    }
  }
  return matches;
}

/// CV_8U: where a picture of `size` lies after a homography, which must leave its corners before the camera.
cv::Mat seen_part(const cv::Matx33d& homography, const cv::Size& size) {
  cv::Mat seen(size, CV_8U, cv::Scalar(0));
  constexpr int kShift = 8;  // bits of a fraction of a pixel
  std::vector<cv::Point> corners;
  for (const auto& [x, y] :
       {std::pair{0, 0}, {size.width - 1, 0}, {size.width - 1, size.height - 1}, {0, size.height - 1}}) {
    const cv::Vec3d h = homography * cv::Vec3d(x, y, 1.0);
    if (h[2] < 1e-3) {
      // A corner behind the camera: the outline is no quadrangle any more.
      cv::warpPerspective(cv::Mat(size, CV_8U, cv::Scalar(255)), seen, cv::Mat(homography), size, cv::INTER_NEAREST);
      return seen;
    }
    const double limit = 1 << 20;
    corners.emplace_back(cvRound(std::clamp(h[0] / h[2], -limit, limit) * (1 << kShift)),
                         cvRound(std::clamp(h[1] / h[2], -limit, limit) * (1 << kShift)));
  }
  cv::fillConvexPoly(seen, corners, 255, cv::LINE_8, kShift);
  return seen;
}

/// `moving` by the result's homography, and where that has pixels.
void warp(const cv::Mat& moving, int margin_px, Alignment& result) {
  const cv::Mat homography(result.reference_from_frame);
  cv::warpPerspective(moving, result.image, homography, moving.size(), cv::INTER_LINEAR, cv::BORDER_REPLICATE);
  result.valid = seen_part(result.reference_from_frame, moving.size());
  const int side = 2 * margin_px + 1;
  cv::erode(result.valid, result.valid, cv::getStructuringElement(cv::MORPH_RECT, {side, side}), {-1, -1}, 1,
            cv::BORDER_CONSTANT, 255);
}

}  // namespace

void validate(const AlignOptions& options) {
  if (options.min_inliers < 4 || options.max_features < options.min_inliers) {
    throw_invalid("align options: give 4 <= min_inliers <= max_features");
  }
  if (!(options.quality > 0.0 && options.quality < 1.0 && options.spacing_px >= 1.0 && options.max_roundtrip_px > 0.0 &&
        options.inlier_px > 0.0 && options.min_inlier_ratio >= 0.0 && options.min_inlier_ratio <= 1.0)) {
    throw_invalid(
        "align options: give quality between 0 and 1, spacing_px of at least 1, positive max_roundtrip_px and "
        "inlier_px, and min_inlier_ratio from 0 to 1");
  }
  if (options.window_px < 5 || options.window_px > 101 || options.levels < 0 || options.levels > 8 ||
      options.margin_px < 0 || options.margin_px > 100) {
    throw_invalid("align options: give window_px from 5 to 101, levels from 0 to 8 and margin_px from 0 to 100");
  }
}

Alignment align_to(const ImageView& reference, const ImageView& frame, const AlignOptions& options) {
  validate(options);
  const cv::Mat fixed = frame_mat(reference);
  const cv::Mat moving = frame_mat(frame);
  if (fixed.empty() || fixed.size() != moving.size() || fixed.rows < kMinSide || fixed.cols < kMinSide) {
    throw_invalid("alignment: give two RGB frames of one size, of 8 pixels a side at least");
  }
  Alignment result;
  result.image = moving.clone();
  result.valid = cv::Mat(moving.size(), CV_8U, cv::Scalar(255));
  cv::Mat fixed_grey;
  cv::Mat moving_grey;
  cv::cvtColor(fixed, fixed_grey, cv::COLOR_RGB2GRAY);
  cv::cvtColor(moving, moving_grey, cv::COLOR_RGB2GRAY);
  const Matches matches = track(fixed_grey, moving_grey, options);
  result.tracked = static_cast<int>(matches.reference.size());
  if (result.tracked < options.min_inliers) {
    return result;
  }
  cv::Mat is_inlier;
  const cv::Mat homography =
      cv::findHomography(matches.frame, matches.reference, cv::RANSAC, options.inlier_px, is_inlier);
  result.inliers = is_inlier.empty() ? 0 : cv::countNonZero(is_inlier);
  if (homography.empty() || result.inliers < options.min_inliers ||
      result.inliers < options.min_inlier_ratio * result.tracked) {
    return result;
  }
  result.found = true;
  result.reference_from_frame = homography;
  warp(moving, options.margin_px, result);
  return result;
}

Alignment derotate_frame(const ImageView& frame, const Eigen::Matrix3d& reference_from_frame, double horizontal_fov_rad,
                         const AlignOptions& options) {
  validate(options);
  const cv::Mat moving = frame_mat(frame);
  if (moving.empty()) {
    throw_invalid("derotation: give an RGB frame");
  }
  const Eigen::Matrix3d& turn = reference_from_frame;
  if (!turn.allFinite() || !(turn * turn.transpose()).isIdentity(1e-3) || turn.determinant() < 0.0) {
    throw_invalid("derotation: reference_from_frame is no rotation");
  }
  const auto camera = geometry::Camera::from_horizontal_fov(moving.cols, moving.rows, horizontal_fov_rad);
  const cv::Matx33d intrinsics(camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0);
  cv::Matx33d rotation;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) {
      rotation(row, column) = turn(row, column);
    }
  }
  Alignment result;
  result.found = true;
  result.reference_from_frame = intrinsics * rotation * intrinsics.inv();
  warp(moving, options.margin_px, result);
  return result;
}

cv::Mat within(const cv::Mat& map, const cv::Mat& valid) {
  cv::Mat result = map.clone();
  if (map.type() != CV_32F || valid.type() != CV_8U || map.size() != valid.size()) {
    return result;
  }
  const int counts = cv::countNonZero(valid);
  if (counts == 0 || counts == static_cast<int>(valid.total())) {
    return result;
  }
  result.setTo(MapHistogram(map, valid).quantile(0.5), valid == 0);
  return result;
}

}  // namespace ajna::tasks
