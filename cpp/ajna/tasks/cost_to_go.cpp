// SPDX-License-Identifier: MIT
#include "ajna/tasks/cost_to_go.hpp"

#include <algorithm>
#include <cmath>

#include "ajna/base/error.hpp"
#include "ajna/tasks/bilinear.hpp"

namespace ajna::tasks {
namespace {

constexpr double kNode_m = 0.2;
constexpr int kRounds = 4;  // of four sweeps: each lets the way turn once more
constexpr double kSettled_m = 0.02;
constexpr float kFar = 1e6F;

}  // namespace

CostToGo::CostToGo(double behind_m, double ahead_m, double side_m) : behind_m_(behind_m), side_m_(side_m) {
  value_.create(2 * static_cast<int>(std::ceil(side_m / kNode_m)) + 1,
                static_cast<int>(std::ceil((behind_m + ahead_m) / kNode_m)) + 1, CV_32F);
  value_.setTo(0.0F);
}

Eigen::Vector2d CostToGo::node(int row, int column) const {
  return {column * kNode_m - behind_m_, row * kNode_m - side_m_};
}

void CostToGo::solve(const cv::Mat& cost, const Eigen::Vector2d& goal_m) {
  if (cost.type() != CV_32F || cost.size() != value_.size()) {
    throw_invalid("cost to go: give costs per metre, float32, of the field's size");
  }
  goal_m_ = goal_m;
  value_.setTo(kFar);
  // The way on from the border is not known: a straight one. None leads out backwards.
  for (int row = 0; row < value_.rows; ++row) {
    const bool side = row == 0 || row + 1 == value_.rows;
    for (int column = side ? 0 : value_.cols - 1; column < value_.cols; ++column) {
      value_.at<float>(row, column) = static_cast<float>((node(row, column) - goal_m).norm());
    }
  }
  for (int round = 0; round < kRounds; ++round) {
    double change = 0.0;
    for (int way = 0; way < 4; ++way) {
      change = std::max(change, sweep(cost, way % 2 == 0, way / 2 != 0));
    }
    if (change < kSettled_m) {
      break;
    }
  }
}

double CostToGo::sweep(const cv::Mat& cost, bool down, bool right) {
  float change = 0.0F;
  const int rows = value_.rows;
  const int columns = value_.cols;
  for (int i = 1; i + 1 < rows; ++i) {
    const int row = down ? i : rows - 1 - i;
    auto* line = value_.ptr<float>(row);
    const auto* above = value_.ptr<float>(row - 1);
    const auto* below = value_.ptr<float>(row + 1);
    const auto* costs = cost.ptr<float>(row);
    for (int j = 0; j + 1 < columns; ++j) {
      const int column = right ? j : columns - 2 - j;
      const float a = std::min(column > 0 ? line[column - 1] : kFar, line[column + 1]);
      const float b = std::min(above[column], below[column]);
      const float step = costs[column] * static_cast<float>(kNode_m);
      const float apart = std::abs(a - b);
      const float value =
          apart >= step ? std::min(a, b) + step : 0.5F * (a + b + std::sqrt(2.0F * step * step - apart * apart));
      if (value < line[column]) {
        change = std::max(change, line[column] - value);
        line[column] = value;
      }
    }
  }
  return static_cast<double>(change);
}

double CostToGo::at(const Eigen::Vector2d& point_m) const {
  if (node(0, value_.cols - 1).x() < point_m.x() || std::abs(point_m.y()) > side_m_) {
    return (point_m - goal_m_).norm();
  }
  const double x = std::clamp((point_m.x() + behind_m_) / kNode_m, 0.0, value_.cols - 1.001);
  const double y = std::clamp((point_m.y() + side_m_) / kNode_m, 0.0, value_.rows - 1.001);
  const double outside_m = (Eigen::Vector2d(x * kNode_m - behind_m_, y * kNode_m - side_m_) - point_m).norm();
  return bilinear(value_, y, x) + outside_m;
}

Eigen::Vector2d CostToGo::downhill(const Eigen::Vector2d& point_m) const {
  const Eigen::Vector2d ahead(kNode_m, 0.0);
  const Eigen::Vector2d aside(0.0, kNode_m);
  const Eigen::Vector2d slope(at(point_m - ahead) - at(point_m + ahead), at(point_m - aside) - at(point_m + aside));
  return slope.norm() > 1e-6 ? Eigen::Vector2d(slope.normalized()) : Eigen::Vector2d((goal_m_ - point_m).normalized());
}

}  // namespace ajna::tasks
