// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>
#include <optional>
#include <vector>

#include "ajna/geometry/focus_of_expansion.hpp"

namespace ajna::tasks {

/// What carries the contour of a gap along.
enum class TrackedSide {
  kForeground,  ///< the wall around it
  kBackground,  ///< what is seen through it
};
const char* to_string(TrackedSide side) noexcept;

struct GapTrackerOptions {
  int max_features = 48;          ///< per side
  double quality = 0.02;          ///< of corners, relative to the best
  double spacing_px = 5.0;        ///< between corners
  double ring = 0.5;              ///< width of the foreground's ring about the contour, share of the gap's diameter
  int window_px = 15;             ///< of the KLT tracker
  int levels = 2;                 ///< of its pyramid
  double max_roundtrip_px = 1.0;  ///< forward-backward check
  int min_features = 8;           ///< fewer on either side: that side is lost; on both: so is the gap
  int refill_below = 25;          ///< corners are sought anew on a side with fewer
  geometry::FitOptions fit;       ///< of the expansion

  GapTrackerOptions();
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const GapTrackerOptions& options);

/// The corners that are being tracked.
struct GapFeatures {
  std::vector<cv::Point2f> foreground;
  std::vector<cv::Point2f> background;
};

/// Carries a contour from frame to frame: KLT (pyramidal Lucas-Kanade) with forward-backward check on either side, a
/// robust expansion fit per side. The contour belongs to the wall and moves with it for as long as enough of the wall
/// can be followed; when it leaves the image, or has no texture, the background takes over (whose expansion is less:
/// the gap then rather looks too small than too large), and hands back when the wall is there again.
class GapTracker {
 public:
  explicit GapTracker(const GapTrackerOptions& options = {});
  /// grey: CV_8U, the frame that `contour` lies in.
  void start(const cv::Mat& grey, const std::vector<cv::Point2f>& contour);
  /// The next frame; false where neither side can be followed: the contour is then of the last good frame.
  bool track(const cv::Mat& grey);

  [[nodiscard]] const std::vector<cv::Point2f>& contour() const noexcept { return contour_; }
  [[nodiscard]] const GapFeatures& features() const noexcept { return features_; }
  [[nodiscard]] TrackedSide side() const noexcept { return side_; }
  [[nodiscard]] const geometry::Expansion& expansion() const noexcept { return expansion_; }  ///< of the last step

 private:
  struct Side {
    std::vector<cv::Point2f> begin, end;
    geometry::Expansion expansion;
  };
  Side advance(const std::vector<cv::Point2f>& points, const std::vector<cv::Mat>& next) const;
  void refill(const cv::Mat& grey);

  GapTrackerOptions options_;
  std::vector<cv::Mat> pyramid_;
  std::vector<cv::Point2f> contour_;
  GapFeatures features_;
  TrackedSide side_ = TrackedSide::kForeground;
  geometry::Expansion expansion_;
};

}  // namespace ajna::tasks
