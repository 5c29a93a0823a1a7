// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>
#include <vector>

#include "ajna/tasks/clock.hpp"
#include "ajna/tasks/map_background.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {

enum class DodgeStatus {
  kNoObstacle,    ///< nothing stands out of the map
  kDetected,      ///< an obstacle, seen in fewer frames than a direction needs
  kIncoming,      ///< tracked: velocity, impact and safe direction are known
  kOutOfOrder,    ///< a time stamp not later than the last: ignored
  kInvalidInput,  ///< a map that cannot be used: the track is dropped
};
const char* to_string(DodgeStatus status) noexcept;

struct DodgeOptions {
  MapOptions map;                 ///< for a small thing before a background that is certain
  BackgroundOptions background;   ///< what a hovering camera has seen before is taken off, once it is known
  double min_contrast = 1.7;      ///< a region's mean over the mean outside
  double min_uncertainty = 0.25;  ///< and its mean, in units of the map; where the background is known, its threshold
  bool convex = true;             ///< the obstacle is the convex hull of its region: rims are seen before the inside
  /// Detections in a row that make a direction (at most 2 in a Skill that plans at 15 Hz or less) ...
  int confirm_frames = 3;
  double confirm_s = 0.2;   ///< ... over at least so long if it hardly moves in the image, as a light that goes on
                            ///< does: that is seen for as long as a pair spans
  double min_move = 0.01;   ///< along the track, in image heights: less is hardly
  double gate = 0.25;       ///< how far a detection may lie from where the track expects it, image diagonals
  double max_gap_s = 0.25;  ///< without a frame for longer, all that was seen is dropped ...
  double max_miss_s = 0.1;  ///< ... and without a detection for longer, the track
  double horizon_s = 0.5;   ///< time to contact where growth does not tell it
  double min_growth_per_s = 0.3;  ///< growth of the diameter below which it does not
  double vertical = 0.0;    ///< how much of the vertical motion counts for the safe direction, 0 to 1: thrown things
                            ///< rise and fall, which says little of where they hit; 0: sideways only
  double direct_hit = 0.1;  ///< an impact nearer to the image's centre than this (image heights) has no side
  double horizontal_fov_rad = 1.2;  ///< of the camera; only used to take its rotation out

  DodgeOptions();
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const DodgeOptions& options);

/// One detection of the obstacle.
struct TrackPoint {
  double time_s = 0.0;
  cv::Point2d center_px;
  double diameter_px = 0.0;  ///< of the disc of equal area
};

struct DodgeResult {
  DodgeStatus status = DodgeStatus::kNoObstacle;
  MapSteps steps;                 ///< of the map, or of its rise above the background
  cv::Mat mask;                   ///< CV_8U: the obstacle; empty without one
  std::optional<Region> region;   ///< of the map that it was found in
  std::vector<TrackPoint> track;  ///< oldest first, at most as many as a fit uses
  Eigen::Vector2d velocity_px_s = Eigen::Vector2d::Zero();
  double time_to_contact_s = 0.0;  ///< from growth, or the horizon
  bool contact_from_growth = false;
  Eigen::Vector2d impact_px = Eigen::Vector2d::Zero();  ///< where it hits on the image plane
  std::optional<Eigen::Vector2d> safe_direction;        ///< unit vector, x right, y down
};

/// Dodging a thrown object with a hovering camera: detect, track over three frames by detection, predict, get away.
///
/// A thing of constant velocity (X', Y', Z') is seen to move by x' = X'/Z + x / t_c (t_c: time to contact, -Z / Z'),
/// and crosses the camera's plane at X + X' t_c = Z t_c x'. So it passes on the side towards which it moves in the
/// image; impact_px = centre + t_c x' is where it hits in units of the depth it has now, and the safe direction leads
/// from there past the image's centre. Vertically the velocity of what was thrown is not constant: see vertical. A
/// thing that does not move in the image hits the camera: then any way across its line of sight is as good, and the one
/// away from where it is seen is taken.
class DodgePipeline {
 public:
  explicit DodgePipeline(const DodgeOptions& options = {});
  /// map: CV_32F, scalar uncertainty of the pair that ends at `time_s`. angular_velocity_rad_s: of the camera, optical
  /// frame, over that pair, if known: turning is then taken out of the track.
  DodgeResult step(const cv::Mat& map, double time_s,
                   const std::optional<Eigen::Vector3d>& angular_velocity_rad_s = std::nullopt);
  void reset() noexcept;
  [[nodiscard]] const DodgeOptions& options() const noexcept { return options_; }

 private:
  struct Motion;  ///< of what is tracked
  [[nodiscard]] bool confirmed(const Motion& motion, const cv::Size& size) const;
  void predict(const Motion& motion, DodgeResult& result, const cv::Size& size) const;
  MapSteps find(const cv::Mat& map, double time_s, double turned_rad);
  std::optional<Region> choose(const MapSteps& steps, double time_s) const;

  DodgeOptions options_;
  FrameClock clock_;
  MapBackground background_;
  double least_ = 0.0;  ///< mean of a region that counts, in units of the last map
  std::vector<TrackPoint> track_;
};

}  // namespace ajna::tasks
