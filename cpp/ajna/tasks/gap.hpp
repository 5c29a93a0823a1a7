// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>
#include <vector>

#include "ajna/base/image_view.hpp"
#include "ajna/geometry/focus_of_expansion.hpp"
#include "ajna/tasks/clock.hpp"
#include "ajna/tasks/gap_detection.hpp"
#include "ajna/tasks/gap_tracker.hpp"

namespace ajna::tasks {

enum class GapStatus {
  kExploring,     ///< uncertainty is being stacked: go on with the exploratory manoeuvre
  kNoGap,         ///< enough of it is stacked, and shows none; stacking begins anew from this frame
  kTracking,      ///< a gap: its contour and safe point are in this frame's pixels
  kThrough,       ///< the contour surrounds the camera: straight ahead
  kLost,          ///< the gap was there and can no longer be followed: stop, and explore again (reset)
  kOutOfOrder,    ///< a time stamp not later than the last: ignored
  kInvalidInput,  ///< a frame or map that cannot be used, or a frame of another size
};
const char* to_string(GapStatus status) noexcept;

struct GapOptions {
  GapDetectionOptions detection;
  GapTrackerOptions tracker;
  int min_pairs = 3;       ///< maps stacked before the first look
  int max_pairs = 12;      ///< without a gap in so many: kNoGap
  double through = 0.7;    ///< share of the image inside the contour that means "through"
  double max_gap_s = 0.5;  ///< missing frames for longer than this lose a gap
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const GapOptions& options);

struct GapResult {
  GapStatus status = GapStatus::kInvalidInput;
  int pairs = 0;                     ///< maps stacked so far
  cv::Mat stacked;                   ///< CV_32F: their mean, on the reference frame's grid; only while exploring
  GapDetection detection;            ///< on the reference frame's grid; only on the frame that detects
  std::vector<cv::Point2f> contour;  ///< of the gap, in this frame
  Eigen::Vector2d safe_px = Eigen::Vector2d::Zero();      ///< median of the region's pixels, in this frame
  Eigen::Vector2d safe_offset = Eigen::Vector2d::Zero();  ///< the same, normalised by the focal length
  GapFeatures features;                                   ///< what is tracked, in this frame
  TrackedSide side = TrackedSide::kForeground;            ///< which of both carries the contour now
  std::optional<Eigen::Vector2d> focus_px;                ///< focus of expansion, where the motion has one
};

/// Finding a gap of unknown shape in a wall, and flying through it.
///
/// Frames during the exploratory manoeuvre are all paired with the first of them, so that their maps lie on one grid
/// and can be averaged: what is seen through the gap moves otherwise than the wall, and stays uncertain. The contour
/// found there is then carried along by features of the wall around it (foreground) or of what is seen through it
/// (background) where the wall cannot be followed, by their common expansion about its focus.
class GapPipeline {
 public:
  /// horizontal_fov_rad: of the camera.
  explicit GapPipeline(const GapOptions& options = {}, double horizontal_fov_rad = 1.2);

  /// frame: RGB. map: CV_32F, scalar uncertainty of the pair (reference frame, this frame), on the reference frame's
  /// grid; needed where wants_map(), ignored otherwise. The first frame becomes the reference.
  GapResult step(const ImageView& frame, const cv::Mat& map, double time_s);
  /// Whether the next step uses a map: after the first frame, until a gap is found.
  [[nodiscard]] bool wants_map() const noexcept { return phase_ == Phase::kStacking; }
  void reset() noexcept;
  [[nodiscard]] const GapOptions& options() const noexcept { return options_; }

 private:
  enum class Phase { kEmpty, kStacking, kTracking, kThrough, kLost };
  void start(const cv::Mat& grey);
  GapResult stack(const cv::Mat& grey, const cv::Mat& map);
  GapResult follow(const cv::Mat& grey);
  void describe(GapResult& result, const cv::Size& size);

  GapOptions options_;
  double horizontal_fov_rad_;
  FrameClock clock_;
  Phase phase_ = Phase::kEmpty;
  cv::Mat reference_;
  cv::Mat sum_;
  int pairs_ = 0;
  GapTracker tracker_;
};

}  // namespace ajna::tasks
