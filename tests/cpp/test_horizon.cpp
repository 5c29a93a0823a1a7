// SPDX-License-Identifier: MIT
// From uncertainty along the horizon to things on the ground plan.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
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

/// The map that a wall across the way at `depth_m` gives by the model that horizon_scan inverts; it stands between
/// `left_m` and `right_m`, both to the right of the heading, and beside it nothing does.
cv::Mat wall(const Eigen::Matrix3d& heading_from_camera, const Eigen::Vector3d& move_m, double depth_m,
             double left_m = -1e9, double right_m = 1e9) {
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
      const double right = depth_m / ray.x() * ray.y();
      const double motion = right >= left_m && right <= right_m ? shift * move_m.norm() / depth : 0.0;
      map.at<float>(y, x) = static_cast<float>(options.floor + options.per_px * motion);
    }
  }
  return map;
}

TEST(Horizon, DistancesOfAWallHoweverTheCameraIsTilted) {
  const Eigen::Vector3d move(0.8, 0.2, 0.0);
  for (const double roll : {0.0, 0.5}) {
    for (const double pitch : {0.0, -0.3}) {
      const Eigen::Matrix3d attitude = Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                       Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()).toRotationMatrix() * level();
      const auto found = horizon_scan(wall(attitude, move, 4.0), {}, attitude, kFov, move);
      ASSERT_TRUE(found) << roll << " " << pitch;
      EXPECT_GT(found->all_things().size(), 100U);
      for (const auto& thing : found->all_things()) {
        // Near the focus of expansion most of the band is further from it than the horizon: that errs to the near side.
        const double off = std::abs(std::atan2(thing.y(), thing.x()) - std::atan2(move.y(), move.x()));
        EXPECT_LT(thing.x(), 4.4) << roll << " " << pitch;
        EXPECT_GT(thing.x(), off > 0.3 ? 3.6 : 2.8) << roll << " " << pitch;
      }
    }
  }
}

TEST(Horizon, AnUprightThingKeepsItsWidthInATurn) {
  // A post, 0.4 m wide, 2.5 m ahead, while the camera leans into a turn: read along columns of the image its edges
  // would be mixed with what lies beside it, and stand at twice the distance.
  const Eigen::Vector3d move(0.8, 0.0, 0.0);
  for (const double roll : {-0.5, 0.0, 0.3, 0.6}) {
    const Eigen::Matrix3d attitude = Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()).toRotationMatrix() * level();
    const auto found = horizon_scan(wall(attitude, move, 2.5, 0.7, 1.1), {}, attitude, kFov, move);
    ASSERT_TRUE(found);
    double left = 1e9;
    double right = -1e9;
    for (const auto& thing : found->all_things()) {
      left = std::min(left, thing.y() / thing.x() * 2.5);
      right = std::max(right, thing.y() / thing.x() * 2.5);
      EXPECT_GT(thing.x(), 2.0) << roll;
      EXPECT_LT(thing.x(), 3.6) << roll;
    }
    EXPECT_NEAR(left, 0.7, 0.06) << roll;
    EXPECT_NEAR(right, 1.1, 0.06) << roll;
  }
}

TEST(Horizon, ACameraThatLooksSteeplyDownSeesNoHorizon) {
  // Ends of upright lines come near to the camera's plane, where they are imaged at any distance.
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(1.0F));
  HorizonOptions options;
  for (const double band : {0.1, 0.2, 0.202, 1.0}) {
    options.band = band;
    for (double pitch = -1.57; pitch <= -1.2; pitch += 0.001) {
      const Eigen::Matrix3d attitude = Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()).toRotationMatrix() * level();
      ASSERT_FALSE(horizon_scan(map, {}, attitude, kFov, {0.4, 0.0, 0.0}, options)) << band << " " << pitch;
    }
  }
}

TEST(Horizon, SaturatedColumnsAreKeptApart) {
  const Eigen::Vector3d move(0.4, 0.0, 0.0);
  const cv::Mat map = wall(level(), move, 1.5);
  HorizonOptions options;
  options.saturated = 1e6;
  const auto open = horizon_scan(map, {}, level(), kFov, move, options);
  const auto found = horizon_scan(map, {}, level(), kFov, move);
  ASSERT_TRUE(open && found);
  EXPECT_TRUE(open->near.empty());
  // Far from the focus of expansion, in the middle, the wall moves most: at both edges of the picture.
  EXPECT_GT(found->near.size(), 20U);
  EXPECT_GT(found->things.size(), 20U);
  EXPECT_EQ(found->all_things().size(), open->things.size());
  for (const auto& thing : found->near) {
    EXPECT_GT(std::abs(thing.y()), 0.5);
    EXPECT_NEAR(thing.x(), 1.5, 0.1) << "read by the same law";
  }
  options.saturated = options.floor - 0.1;
  EXPECT_THROW(validate(options), Error);
}

TEST(Horizon, CertainIsFree) {
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(0.1F));
  const auto found = horizon_scan(map, {}, level(), kFov, {0.4, 0, 0});
  ASSERT_TRUE(found);
  EXPECT_TRUE(found->things.empty());
  EXPECT_EQ(found->free.size(), static_cast<std::size_t>(kWidth / HorizonOptions{}.column_step));
  for (const auto& point : found->free) {
    EXPECT_NEAR(point.norm(), 10.0 * 0.4, 1e-9) << "further away a thing would move too little to be seen";
  }
  const auto longer = horizon_scan(map, {}, level(), kFov, {1.0, 0, 0});
  ASSERT_TRUE(longer && !longer->free.empty());
  EXPECT_NEAR(longer->free.front().norm(), HorizonOptions{}.max_distance_m, 1e-9);
}

TEST(Horizon, BeyondItsRangeAThingIsNotSeen) {
  const Eigen::Vector3d move(0.4, 0.1, 0.0);
  const auto found = horizon_scan(wall(level(), move, 5.0), {}, level(), kFov, move);
  ASSERT_TRUE(found);
  for (const auto& thing : found->all_things()) {
    EXPECT_LE(thing.norm(), 10.0 * move.norm()) << "near the focus of expansion the wall reads nearer";
  }
  EXPECT_GT(found->free.size(), 100U);
}

TEST(Horizon, SaysWhereItSeesNothing) {
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(1.0F));
  EXPECT_FALSE(horizon_scan(map, {}, level(), kFov, {0.01, 0, 0})) << "hardly a motion";
  EXPECT_FALSE(horizon_scan(map, {}, level(), kFov, {-0.4, 0, 0})) << "backwards";
  const Eigen::Matrix3d down = Eigen::AngleAxisd(-1.2, Eigen::Vector3d::UnitY()).toRotationMatrix() * level();
  EXPECT_FALSE(horizon_scan(map, {}, down, kFov, {0.4, 0, 0})) << "the horizon is out of the picture";
  cv::Mat valid(kHeight, kWidth, CV_8U, cv::Scalar(255));
  EXPECT_TRUE(horizon_scan(map, valid, level(), kFov, {0.4, 0, 0}));
  valid.colRange(0, 200).setTo(0);
  EXPECT_FALSE(horizon_scan(map, valid, level(), kFov, {0.4, 0, 0})) << "most of it has no picture";
}

TEST(Horizon, WrongInputIsNamed) {
  EXPECT_THROW(horizon_scan({}, {}, level(), kFov, {0.4, 0, 0}), Error);
  EXPECT_THROW(horizon_scan(cv::Mat::zeros(10, 10, CV_8U), {}, level(), kFov, {0.4, 0, 0}), Error);
  EXPECT_THROW(horizon_scan(cv::Mat::zeros(10, 10, CV_32F), cv::Mat::zeros(5, 5, CV_8U), level(), kFov, {0.4, 0, 0}),
               Error);
  HorizonOptions horizon;
  horizon.per_px = 0.0;
  EXPECT_THROW(validate(horizon), Error);
}

}  // namespace
}  // namespace ajna::tasks
