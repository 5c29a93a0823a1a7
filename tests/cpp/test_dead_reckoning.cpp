// SPDX-License-Identifier: MIT
// Where the camera has come from measured velocities, against ways in closed form.
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>

#include "ajna/skills/dead_reckoning.hpp"

namespace ajna::skills {
namespace {

using Eigen::Vector3d;

TEST(DeadReckoning, SpeedingUpIsExact) {
  DeadReckoning way(0.0, 1.0);
  for (int i = 0; i <= 30; ++i) {
    const double t = i / 30.0;
    way.move(t, 0.0, {2.3 * t, 0.1, -0.2 * t});
  }
  EXPECT_TRUE(way.position_m().isApprox(Vector3d(1.15, 0.1, -0.1), 1e-9));
  // The last velocity times the time would be 0.69 m.
  const auto moved = way.moved_since(0.7);
  ASSERT_TRUE(moved);
  EXPECT_NEAR(moved->x(), 1.15 * (1.0 - 0.49), 1e-3);
  EXPECT_NEAR(moved->y(), 0.03, 1e-9);
  EXPECT_NEAR(moved->z(), -0.1 * (1.0 - 0.49), 1e-3);
  EXPECT_NEAR(way.moved_since(1.0)->norm(), 0.0, 1e-12);
}

TEST(DeadReckoning, ACircleInTheHeadingFrame) {
  // 2 m/s ahead while it turns right by 1.5 rad/s: a circle of 4/3 m to the right.
  constexpr double kSpeed = 2.0;
  constexpr double kTurn = 1.5;
  DeadReckoning way(0.0, 1.0);
  for (int i = 0; i <= 200; ++i) {
    way.move(i * 0.005, kTurn * i * 0.005, {kSpeed, 0.0, 0.0});
  }
  const double radius = kSpeed / kTurn;
  EXPECT_NEAR(way.position_m().x(), radius * std::sin(kTurn), 1e-4);
  EXPECT_NEAR(way.position_m().y(), radius * (1.0 - std::cos(kTurn)), 1e-4);
  const auto moved = way.moved_since(0.6);
  ASSERT_TRUE(moved);
  EXPECT_NEAR(moved->x(), radius * std::sin(kTurn * 0.4), 1e-4);
  EXPECT_NEAR(moved->y(), -radius * (1.0 - std::cos(kTurn * 0.4)), 1e-4) << "seen from here it came from the right";
}

TEST(DeadReckoning, TheCameraSwingsWhereTheVehicleTurnsOnTheSpot) {
  DeadReckoning way(0.1, 1.0);
  way.move(0.0, 0.0, Vector3d::Zero());
  way.move(0.2, 0.3, Vector3d::Zero());
  EXPECT_TRUE(way.position_m().isApprox(0.1 * Vector3d(std::cos(0.3), std::sin(0.3), 0.0), 1e-12));
  EXPECT_NEAR(way.moved_since(0.0)->y(), 0.1 * std::sin(0.3), 1e-12);
}

TEST(DeadReckoning, SaysNothingOfAWayThatWasNotMeasured) {
  DeadReckoning way(0.0, 0.4);
  EXPECT_FALSE(way.moved_since(0.0));
  way.move(0.0, 0.0, {1.0, 0.0, 0.0});
  way.move(0.1, 0.0, {1.0, 0.0, 0.0});
  EXPECT_FALSE(way.moved_since(-0.1)) << "before the beginning";
  EXPECT_FALSE(way.moved_since(0.2)) << "not yet";
  EXPECT_NEAR(way.moved_since(0.05)->x(), 0.05, 1e-12) << "between two measurements";
  way.move(0.1, 0.0, {9.0, 0.0, 0.0});
  way.move(0.05, 0.0, {9.0, 0.0, 0.0});
  EXPECT_NEAR(way.position_m().x(), 0.1, 1e-12) << "no later than the last: ignored";
  way.lose();
  EXPECT_FALSE(way.moved_since(0.05));
  way.move(0.2, 0.0, {1.0, 0.0, 0.0});
  EXPECT_FALSE(way.moved_since(0.05)) << "a frame without a velocity lies between";
  EXPECT_TRUE(way.moved_since(0.2));
  way.move(0.9, 0.0, {1.0, 0.0, 0.0});
  EXPECT_FALSE(way.moved_since(0.2)) << "too long ago to be guessed";
  for (int i = 1; i <= 10; ++i) {
    way.move(0.9 + 0.1 * i, 0.0, {1.0, 0.0, 0.0});
  }
  EXPECT_FALSE(way.moved_since(1.2)) << "forgotten";
  EXPECT_NEAR(way.moved_since(1.5)->x(), 0.4, 1e-9);
  way.reset();
  EXPECT_FALSE(way.moved_since(1.9));
  EXPECT_EQ(way.position_m().norm(), 0.0);
}

}  // namespace
}  // namespace ajna::skills
