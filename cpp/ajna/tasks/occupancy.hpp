// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "ajna/tasks/horizon.hpp"

namespace ajna::tasks {

/// How readings of distance become a map of what stands where. Evidence is a log-odds: above 0 something stands there.
struct OccupancyOptions {
  double cell_m = 0.2;
  double seen = 0.9;         ///< evidence of one frame that a thing stands where it is read; less beyond sure_m
  double passed = 0.25;      ///< evidence against it, where rays pass
  double sure_m = 4.0;       ///< readings beyond count as sure_m over their distance
  double clear_share = 0.7;  ///< a ray passes so much of the distance that is read: that may be too large
  double clear_near = 0.0;   ///< where the map is saturated: the reading bounds the distance from above only
  double thickness = 0.15;   ///< a thing is marked so far beyond its distance, as a share of it
  double bound = 3.0;        ///< of the evidence, both ways
  double blocked = 0.8;      ///< a cell with more evidence counts as a thing
  double forget_m = 5.0;  ///< evidence falls to 1/e while the vehicle moves so far; at rest none: nothing new is seen
  double max_range_m = 9.0;  ///< cells further away are not kept
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const OccupancyOptions& options);

/// A map of evidence on axes that do not turn with the vehicle (north, east), about where the vehicle is: single frames
/// err, many that agree do not.
class OccupancyMap {
 public:
  explicit OccupancyMap(const OccupancyOptions& options = {});
  /// Add a frame's scan. position_m: north, east; yaw_rad: of the heading frame, to the right.
  void add(const HorizonScan& scan, const Eigen::Vector2d& position_m, double yaw_rad);
  /// Centres of the cells that count as things, in the heading frame (forward, right).
  [[nodiscard]] Obstacles things(const Eigen::Vector2d& position_m, double yaw_rad) const;
  /// Evidence at a point (north, east); 0 where nothing is known.
  [[nodiscard]] double evidence(const Eigen::Vector2d& point_m) const;
  void reset() noexcept;

 private:
  struct Cell {
    int north = 0;
    int east = 0;
    float evidence = 0.0F;
    std::uint16_t hits = 0;  ///< of this frame
    std::uint16_t passes = 0;
    float weight = 0.0F;
  };
  [[nodiscard]] int index_of(double metres) const;
  Cell& cell(int north, int east);
  void forget(const Eigen::Vector2d& position_m);

  OccupancyOptions options_;
  int side_;  ///< cells; indices wrap round, and a cell knows where it is
  std::vector<Cell> cells_;
  std::vector<std::size_t> touched_;
  bool any_ = false;
  Eigen::Vector2d last_m_ = Eigen::Vector2d::Zero();
};

}  // namespace ajna::tasks
