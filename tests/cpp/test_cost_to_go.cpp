// SPDX-License-Identifier: MIT
// What the cheapest way to a far goal costs, against closed forms.
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>
#include <opencv2/core.hpp>

#include "ajna/base/error.hpp"
#include "ajna/tasks/cost_to_go.hpp"

namespace ajna::tasks {
namespace {

using Eigen::Vector2d;

cv::Mat free_of(const CostToGo& field) { return {field.rows(), field.columns(), CV_32F, cv::Scalar(1.0)}; }

/// A line of nodes across, at some distance forward, from `from` to `to` (to the right), that cost much.
void block(const CostToGo& field, cv::Mat& cost, double forward_m, double from_m, double to_m, float value = 100.0F) {
  for (int row = 0; row < field.rows(); ++row) {
    for (int column = 0; column < field.columns(); ++column) {
      const Vector2d at = field.node(row, column);
      if (std::abs(at.x() - forward_m) < 0.15 && at.y() >= from_m && at.y() <= to_m) {
        cost.at<float>(row, column) = value;
      }
    }
  }
}

TEST(CostToGo, IsTheDistanceWhereAllIsFree) {
  CostToGo field(1.0, 9.0, 6.0);
  const Vector2d goal(15.0, 2.0);
  field.solve(free_of(field), goal);
  for (const Vector2d& at : {Vector2d(0, 0), Vector2d(3.3, -2.1), Vector2d(-0.5, 4.0), Vector2d(8.9, 0.05)}) {
    EXPECT_NEAR(field.at(at), (goal - at).norm(), 0.12) << at.transpose();
    EXPECT_GT(field.downhill(at).dot((goal - at).normalized()), 0.99) << at.transpose();
    EXPECT_NEAR(field.downhill(at).norm(), 1.0, 1e-9);
  }
  EXPECT_NEAR(field.at({-3.0, 0.0}), 2.0 + field.at({-1.0, 0.0}), 1e-3);
  EXPECT_NEAR(field.at({12.0, 2.0}), 3.0, 1e-9);
  EXPECT_NEAR(field.at({3.0, 10.0}), std::hypot(12.0, 8.0), 1e-9);
}

TEST(CostToGo, GoesRoundWhatBlocks) {
  CostToGo field(1.0, 9.0, 6.0);
  cv::Mat cost = free_of(field);
  block(field, cost, 3.0, -1.01, 3.01);
  const Vector2d goal(15.0, 0.0);
  field.solve(cost, goal);
  const Vector2d corner(3.0, -1.2);  // the first free node
  EXPECT_NEAR(field.at({0.0, 0.0}), corner.norm() + (goal - corner).norm(), 0.25);
  EXPECT_LT(field.downhill({1.0, 0.0}).y(), -0.2) << "round its nearer end";
  EXPECT_GT(field.downhill({2.4, 2.9}).y(), 0.2) << "there the other one is nearer";
}

TEST(CostToGo, ATrapIsLeftTheWayItWasEntered) {
  // Three walls: ahead, and to both sides back to the camera. From within the way leads backwards first.
  CostToGo field(1.0, 9.0, 6.0);
  cv::Mat cost = free_of(field);
  block(field, cost, 3.0, -1.5, 1.5);
  for (int row = 0; row < field.rows(); ++row) {
    for (int column = 0; column < field.columns(); ++column) {
      const Vector2d at = field.node(row, column);
      if (at.x() > 0.5 && at.x() < 3.1 && std::abs(std::abs(at.y()) - 1.4) < 0.15) {
        cost.at<float>(row, column) = 100.0F;
      }
    }
  }
  field.solve(cost, {15.0, 0.0});
  EXPECT_LT(field.downhill({1.6, 0.3}).x(), -0.3);
  EXPECT_GT(field.at({2.0, 0.0}), field.at({0.0, 0.0}));
}

TEST(CostToGo, CostsAsMuchAsTheWayDoes) {
  // All of it three times as dear: three times the way, but for the last part, beyond the border.
  CostToGo field(1.0, 9.0, 6.0);
  field.solve(cv::Mat(3.0F * free_of(field)), {15.0, 0.0});
  EXPECT_NEAR(field.at({4.0, 0.0}), 3.0 * 5.0 + 6.0, 0.3);
  EXPECT_NEAR(field.at({4.0, 0.0}) - field.at({5.0, 0.0}), 3.0, 0.05);
}

TEST(CostToGo, CostsOfAnotherSizeAreRefused) {
  CostToGo field(1.0, 9.0, 6.0);
  EXPECT_THROW(field.solve(cv::Mat(3, 3, CV_32F, cv::Scalar(1.0)), {15.0, 0.0}), Error);
  EXPECT_THROW(field.solve(cv::Mat(field.rows(), field.columns(), CV_64F, cv::Scalar(1.0)), {15.0, 0.0}), Error);
}

}  // namespace
}  // namespace ajna::tasks
