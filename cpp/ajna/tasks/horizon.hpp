// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <optional>
#include <vector>

namespace ajna::tasks {

/// From uncertainty along the horizon to where things stand, seen from above. For a vehicle that holds its height, what
/// it can hit lies at the height of its camera: on the horizon of its image, however it is tilted.
struct HorizonOptions {
  double band = 0.1;            ///< half height of the band about the horizon, as a slope (tangent)
  double floor = 0.272;         ///< uncertainty without motion, units of the map
  double per_px = 0.0314;       ///< uncertainty per pixel of motion
  double least_shift_px = 3.4;  ///< a pixel's uncertainty is that of one at least so far from the focus of expansion:
                                ///< a network sees a thing's motion, not a pixel's
  double saturated = 1.0;  ///< from here on uncertainty grows less than motion does: a thing that shows as much may
                           ///< be nearer than it reads
  double max_distance_m = 9.0;  ///< further is free ...
  double range_moves = 10.0;    ///< ... and so far is all that the map tells of: what is further than so many times
                                ///< the camera's motion moves too little in the picture
  double min_move_m = 0.12;     ///< between the frames: less shows nothing
  int column_step = 2;          ///< pixels
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const HorizonOptions& options);

/// A thing at the camera's height: forward and right of it in the levelled heading frame, metres.
using Obstacles = std::vector<Eigen::Vector2d>;

/// What each column of a map shows.
struct HorizonScan {
  Obstacles things;  ///< within range
  Obstacles near;    ///< as near as this or nearer, where the map is saturated
  Obstacles free;    ///< columns that show nothing there: the point at the end of the range
  /// `things`, then `near`.
  [[nodiscard]] Obstacles all_things() const;
};

/// The nearest thing of each column of the map: of the mean uncertainty in the band and the mean distance there from
/// the focus of expansion. A point at depth Z that is r pixels from that focus moves by r b / Z pixels while the camera
/// moves by b; so with uncertainty Y = floor + per_px (r + least_shift_px) b / Z, the depth is per_px (r +
/// least_shift_px) b / (Y - floor). A column with Y of `saturated` or more goes into `near`: that depth bounds it from
/// above. The range is max_distance_m, or range_moves times the camera's motion where that is less.
///
/// map: CV_32F, of a pair from which turning is taken out. valid: CV_8U, 0 where the map says nothing; empty: nowhere.
/// heading_from_camera: rotation, see skills::Attitude. move_m: the camera's motion between the frames, heading frame.
/// Nothing where it is shorter than min_move_m, or backwards, or where less than half of the columns see the horizon.
/// Throws Error(kInvalidArgument) for a map or a mask that is none.
std::optional<HorizonScan> horizon_scan(const cv::Mat& map, const cv::Mat& valid,
                                        const Eigen::Matrix3d& heading_from_camera, double horizontal_fov_rad,
                                        const Eigen::Vector3d& move_m, const HorizonOptions& options = {});

}  // namespace ajna::tasks
