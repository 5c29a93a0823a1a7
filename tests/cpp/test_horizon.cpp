// SPDX-License-Identifier: MIT
// From uncertainty along the horizon to things on the ground plan, and the choice of a corridor between them.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <opencv2/core.hpp>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/tasks/horizon.hpp"

namespace ajna::tasks {
namespace {

constexpr int kWidth = 320;
constexpr int kHeight = 240;
constexpr double kFov = 1.4;

Eigen::Matrix3d level() {
  Eigen::Matrix3d axes;
  axes << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  return axes;
}

/// The map that a wall across the way at `depth_m` gives by the model that horizon_obstacles inverts.
cv::Mat wall(const Eigen::Matrix3d& heading_from_camera, const Eigen::Vector3d& move_m, double depth_m) {
  const HorizonOptions options;
  const auto camera = geometry::Camera::from_horizontal_fov(kWidth, kHeight, kFov);
  const Eigen::Vector2d focus = *camera.project(heading_from_camera.transpose() * move_m);
  cv::Mat map(kHeight, kWidth, CV_32F);
  for (int y = 0; y < kHeight; ++y) {
    for (int x = 0; x < kWidth; ++x) {
      const Eigen::Vector2d normalized = camera.normalize({x, y});
      const Eigen::Vector3d ray = heading_from_camera * Eigen::Vector3d(normalized.x(), normalized.y(), 1.0);
      const double depth = depth_m / ray.x();  // along the optical axis, to a wall that stands across the heading
      const double shift = (Eigen::Vector2d(x, y) - focus).norm() + options.least_shift_px;
      map.at<float>(y, x) = static_cast<float>(options.floor + options.per_px * shift * move_m.norm() / depth);
    }
  }
  return map;
}

TEST(Horizon, DistancesOfAWallHoweverTheCameraIsTilted) {
  const Eigen::Vector3d move(0.4, 0.1, 0.0);
  for (const double roll : {0.0, 0.5}) {
    for (const double pitch : {0.0, -0.3}) {
      const Eigen::Matrix3d attitude = Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                       Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()).toRotationMatrix() * level();
      const auto found = horizon_obstacles(wall(attitude, move, 4.0), {}, attitude, kFov, move);
      ASSERT_TRUE(found) << roll << " " << pitch;
      EXPECT_GT(found->size(), 100U);
      for (const auto& thing : *found) {
        // Near the focus of expansion most of the band is further from it than the horizon: that errs to the near side.
        const double off = std::abs(std::atan2(thing.y(), thing.x()) - std::atan2(move.y(), move.x()));
        EXPECT_LT(thing.x(), 4.4) << roll << " " << pitch;
        EXPECT_GT(thing.x(), off > 0.3 ? 3.6 : 2.8) << roll << " " << pitch;
      }
    }
  }
}

TEST(Horizon, CertainIsFree) {
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(0.1F));
  const auto found = horizon_obstacles(map, {}, level(), kFov, {0.4, 0, 0});
  ASSERT_TRUE(found);
  EXPECT_TRUE(found->empty());
}

TEST(Horizon, SaysWhereItSeesNothing) {
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(1.0F));
  EXPECT_FALSE(horizon_obstacles(map, {}, level(), kFov, {0.01, 0, 0})) << "hardly a motion";
  EXPECT_FALSE(horizon_obstacles(map, {}, level(), kFov, {-0.4, 0, 0})) << "backwards";
  const Eigen::Matrix3d down = Eigen::AngleAxisd(-1.2, Eigen::Vector3d::UnitY()).toRotationMatrix() * level();
  EXPECT_FALSE(horizon_obstacles(map, {}, down, kFov, {0.4, 0, 0})) << "the horizon is out of the picture";
  cv::Mat valid(kHeight, kWidth, CV_8U, cv::Scalar(255));
  EXPECT_TRUE(horizon_obstacles(map, valid, level(), kFov, {0.4, 0, 0}));
  valid.colRange(0, 200).setTo(0);
  EXPECT_FALSE(horizon_obstacles(map, valid, level(), kFov, {0.4, 0, 0})) << "most of it has no picture";
}

TEST(Horizon, WrongInputIsNamed) {
  EXPECT_THROW(horizon_obstacles({}, {}, level(), kFov, {0.4, 0, 0}), Error);
  EXPECT_THROW(horizon_obstacles(cv::Mat::zeros(10, 10, CV_8U), {}, level(), kFov, {0.4, 0, 0}), Error);
  EXPECT_THROW(
      horizon_obstacles(cv::Mat::zeros(10, 10, CV_32F), cv::Mat::zeros(5, 5, CV_8U), level(), kFov, {0.4, 0, 0}),
      Error);
  HorizonOptions horizon;
  horizon.per_px = 0.0;
  EXPECT_THROW(validate(horizon), Error);
  CorridorOptions corridor;
  corridor.support = 0;
  EXPECT_THROW(validate(corridor), Error);
}

/// A trunk: a row of points across the way.
Obstacles trunk(double forward_m, double right_m, double width_m = 0.8) {
  Obstacles points;
  const int last = static_cast<int>(width_m / 0.1);
  for (int i = 0; i <= last; ++i) {
    points.emplace_back(forward_m, right_m + width_m * (i / static_cast<double>(last) - 0.5));
  }
  return points;
}

TEST(Corridor, StraightToTheGoalWhereNothingStands) {
  CorridorPlanner planner;
  const Corridor corridor = planner.plan({}, 0.0, {0, 0}, 0.0, 0.3);
  EXPECT_NEAR(corridor.angle_rad, 0.3, 0.02);
  EXPECT_EQ(corridor.free_m, planner.options().horizon_m);
  EXPECT_EQ(corridor.goal_free_m, planner.options().horizon_m);
  EXPECT_GT(corridor.speed_m_s, 8.0);
}

TEST(Corridor, PassesATrunkOnItsFreeSide) {
  for (const double side : {-1.0, 1.0}) {
    CorridorPlanner planner;
    const Corridor corridor = planner.plan(trunk(4.0, 0.2 * side), 0.0, {0, 0}, 0.0, 0.0);
    EXPECT_LT(corridor.angle_rad * side, -0.1);
    // At the trunk the corridor's edge is beyond the trunk's.
    EXPECT_LT(4.0 * std::tan(corridor.angle_rad) * side + planner.options().half_width_m, 0.2 - 0.4 + 0.05);
    EXPECT_NEAR(corridor.goal_free_m, 4.0, 0.1);
    EXPECT_EQ(corridor.free_m, planner.options().horizon_m);
  }
}

TEST(Corridor, SinglePointsDoNotBlockTheWay) {
  CorridorPlanner planner;
  const Corridor corridor = planner.plan({{3.0, 0.0}, {2.0, 0.1}}, 0.0, {0, 0}, 0.0, 0.0);
  EXPECT_NEAR(corridor.angle_rad, 0.0, 0.02);
}

TEST(Corridor, KeepsItsSide) {
  CorridorPlanner planner;
  const Corridor first = planner.plan(trunk(4.0, 0.1), 0.0, {0, 0}, 0.0, 0.0);
  ASSERT_LT(first.angle_rad, 0.0);
  EXPECT_LT(planner.plan(trunk(3.9, -0.1), 0.03, {0.1, 0}, 0.0, 0.0).angle_rad, 0.0) << "the other side is no better";
  planner.reset();
  EXPECT_GT(planner.plan(trunk(3.9, -0.1), 0.06, {0.1, 0}, 0.0, 0.0).angle_rad, 0.0);
}

TEST(Corridor, RemembersWhatHasLeftThePicture) {
  CorridorPlanner planner;
  planner.plan(trunk(1.5, 0.6), 0.0, {0, 0}, 0.0, 0.0);
  // A metre further, and turned to the left by 0.3: seen from here the trunk stands 0.5 m ahead.
  const Corridor later = planner.plan({}, 0.3, {1.0, 0.0}, -0.3, 0.3);
  EXPECT_LT(later.angle_rad, 0.3) << "towards the goal it would still be hit";
  EXPECT_LT(later.goal_free_m, 1.0);
  EXPECT_EQ(planner.plan({}, 0.6, {5.0, 0.0}, 0.0, 0.0).goal_free_m, planner.options().horizon_m) << "passed";
  planner.plan(trunk(1.5, 0.0), 1.0, {5.0, 0.0}, 0.0, 0.0);
  EXPECT_LT(planner.plan({}, 60.0, {5.0, 0.0}, 0.0, 0.0).goal_free_m, 2.0) << "at rest nothing new is seen";
  EXPECT_EQ(planner.plan({}, 61.0, {4.4, 0.0}, 0.0, 0.0).goal_free_m, planner.options().horizon_m) << "too long ago";
}

TEST(Corridor, SlowsDownBeforeAWall) {
  CorridorPlanner planner;
  const Corridor corridor = planner.plan(trunk(1.3, 0.0, 20.0), 0.0, {0, 0}, 0.0, 0.0);
  EXPECT_LT(corridor.free_m, 2.0);
  const double room = corridor.free_m - planner.options().stop_m;
  EXPECT_NEAR(corridor.speed_m_s * corridor.speed_m_s, 2.0 * planner.options().brake_m_s2 * room, 1e-9);
}

}  // namespace
}  // namespace ajna::tasks
