// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>

#include "ajna/tasks/clock.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {

enum class NavigateStatus {
  kOk,
  kBlocked,       ///< no free space that the vehicle fits through: stop
  kOutOfOrder,    ///< a time stamp not later than the last: ignored
  kInvalidInput,  ///< a map that cannot be used
};
const char* to_string(NavigateStatus status) noexcept;

/// How the weight w of Eq. 3 follows from what is near. Y stands in for inverse depth: Z_close / Z_o = Y_o / Y_close.
enum class WeightRule {
  kLimits,    ///< tanh((r - 1) / 2), r = (Y_close + Y_o) / (2 Y_free): 0 with nothing near, towards 1 with a near thing
  kRescaled,  ///< 2 / (1 + exp(1 - Z_o / Z_close)) - 1: the printed form, moved to begin at 0 where Z_o = Z_close
  kPrinted,   ///< 1 / (1 + exp(-Z_o / Z_close)): Eq. 6 as printed, which stays above 0.73
};
const char* to_string(WeightRule rule) noexcept;
/// w, 0 to 1. y_close >= y_other >= 0; y_free >= 0 is the level of the free space. floor: levels below it count as it.
double navigation_weight(WeightRule rule, double y_close, double y_other, double y_free, double floor);

struct NavigateOptions {
  MapOptions map;  ///< closing joins the two rims of a trunk, and must not close what one flies through; nor is
                   ///< what uncertainty surrounds filled: straight ahead nothing moves, and all around does
  double window_width = 0.7;   ///< neighbourhood of the goal, as a share of the image's width
  double window_height = 0.4;  ///< and of its height
  WeightRule weight = WeightRule::kLimits;
  double delta = 0.15;              ///< the second most unsafe region is further by this share at least (Eq. 6's delta)
  int directions = 9;               ///< columns of the window in which Z_o,i is read; as many rows as make them square
  double floor = 0.3;               ///< uncertainty, in units of the map, below which nothing is near
  double blocked = 4.0;             ///< a window uncertain throughout, at or above this level, is a wall (or blindness)
  double keep = 2.0;                ///< the free space of the last frame is left for one this many times as large only
  double min_free_area = 0.04;      ///< smallest free space, as a share of the window
  double min_clearance = 0.03;      ///< smallest clearance about its centre, as a share of the image's width
  double horizontal_fov_rad = 1.2;  ///< of the camera
  double max_gap_s = 0.5;           ///< longer intervals are not used to take rotation out

  NavigateOptions();
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const NavigateOptions& options);

struct NavigateResult {
  NavigateStatus status = NavigateStatus::kInvalidInput;
  MapSteps steps;
  cv::Rect window;  ///< the neighbourhood N
  FreeSpace free;   ///< in it
  Eigen::Vector2d goal_px = Eigen::Vector2d::Zero();
  Eigen::Vector2d free_px = Eigen::Vector2d::Zero();  ///< the safe point
  cv::Rect close_box;                                 ///< the most unsafe cell of the window
  cv::Rect other_box;                                 ///< the second most unsafe one; empty where there is none
  double y_close = 0.0;  ///< their largest uncertainty, over parts of a few pixels, units of the map
  double y_other = 0.0;
  double y_free = 0.0;                                        ///< mean uncertainty of the free space
  double weight = 0.0;                                        ///< w
  Eigen::Vector3d goal_direction = Eigen::Vector3d::UnitX();  ///< v_g, unit vector, body frame (forward, right, down)
  Eigen::Vector3d free_direction = Eigen::Vector3d::UnitX();  ///< v_free; v_g where the map is flat
};

/// Finding the way through static clutter: the largest free space near the goal's direction, and how much it counts.
class NavigatePipeline {
 public:
  explicit NavigatePipeline(const NavigateOptions& options = {});
  /// map: CV_32F, scalar uncertainty of the pair that ends at time_s. goal_direction: body frame, any positive length;
  /// a goal outside of the image is brought to its edge. angular_velocity_rad_s: of the camera, optical frame, if
  /// known: the map lies on the first frame's grid, and directions are given as of the second frame.
  NavigateResult step(const cv::Mat& map, double time_s,
                      const Eigen::Vector3d& goal_direction = Eigen::Vector3d::UnitX(),
                      const std::optional<Eigen::Vector3d>& angular_velocity_rad_s = std::nullopt);
  void reset() noexcept;
  [[nodiscard]] const NavigateOptions& options() const noexcept { return options_; }

 private:
  void weigh(NavigateResult& result) const;

  NavigateOptions options_;
  FrameClock clock_;
  std::optional<cv::Point2d> last_free_px_;
};

}  // namespace ajna::tasks
