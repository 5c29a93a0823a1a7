// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <opencv2/core.hpp>

namespace ajna::tasks {

/// What the cheapest way from a point to a far goal costs, in metres of free way, for all points about a vehicle: the
/// viscosity solution V of |grad V| = cost, by fast sweeping (Zhao, Math. Comp. 74, 2005). Points are in the heading
/// frame (forward, right), metres.
class CostToGo {
 public:
  /// The field reaches from behind_m behind to ahead_m ahead and side_m to both sides.
  CostToGo(double behind_m, double ahead_m, double side_m);
  /// cost: CV_32F of rows() x columns(), from 1 (free) per metre, at the nodes; goal_m: outside of the field, or in it.
  /// Throws Error(kInvalidArgument) for another size or type.
  void solve(const cv::Mat& cost, const Eigen::Vector2d& goal_m);
  /// V; ahead and aside of the field the distance to the goal, behind it the way into it as well.
  [[nodiscard]] double at(const Eigen::Vector2d& point_m) const;
  /// Unit vector along which V falls; towards the goal where it is flat.
  [[nodiscard]] Eigen::Vector2d downhill(const Eigen::Vector2d& point_m) const;
  [[nodiscard]] int rows() const noexcept { return value_.rows; }
  [[nodiscard]] int columns() const noexcept { return value_.cols; }
  [[nodiscard]] Eigen::Vector2d node(int row, int column) const;

 private:
  double sweep(const cv::Mat& cost, bool down, bool right);

  double behind_m_;
  double side_m_;
  Eigen::Vector2d goal_m_ = Eigen::Vector2d::UnitX();
  cv::Mat value_;  ///< CV_32F, rows to the right, columns forward
};

}  // namespace ajna::tasks
