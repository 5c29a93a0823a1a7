// SPDX-License-Identifier: MIT
// The map of what many frames have shown.
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>

#include "ajna/base/error.hpp"
#include "ajna/tasks/corridor.hpp"
#include "horizon_scans.hpp"

namespace ajna::tasks {
namespace {

using Eigen::Vector2d;

TEST(Occupancy, AThingIsWhereItIsSeenWhateverTheHeading) {
  for (const double yaw : {0.0, 1.0, -2.5}) {
    for (const Vector2d& at : {Vector2d(0, 0), Vector2d(-31.3, 57.9)}) {
      OccupancyMap map;
      map.add(trunk(3.0, 0.5), at, yaw);
      const Vector2d forward(std::cos(yaw), std::sin(yaw));
      const Vector2d right(-forward.y(), forward.x());
      EXPECT_GT(map.evidence(at + 3.1 * forward + 0.5 * right), 0.5);
      EXPECT_LT(map.evidence(at + 1.0 * forward), 0.0) << "rays passed there";
      EXPECT_EQ(map.evidence(at + 5.0 * forward + 0.8 * right), 0.0) << "behind it nothing is known";
      EXPECT_EQ(map.evidence(at - 2.0 * forward), 0.0);
      const Obstacles things = map.things(at, yaw);
      ASSERT_FALSE(things.empty());
      for (const auto& thing : things) {
        EXPECT_NEAR(thing.x(), 3.25, 0.5);
        EXPECT_NEAR(thing.y(), 0.5, 0.5);
      }
    }
  }
}

TEST(Occupancy, OneFrameThatErrsIsOutvoted) {
  OccupancyMap map;
  for (int i = 0; i < 10; ++i) {
    map.add(i == 5 ? trunk(2.0, 0.0) : nothing(), {0, 0}, 0.0);
  }
  EXPECT_TRUE(map.things({0, 0}, 0.0).empty());
  for (int i = 10; i < 20; ++i) {
    map.add(i == 15 ? nothing() : trunk(2.0, 0.0), {0, 0}, 0.0);
  }
  EXPECT_FALSE(map.things({0, 0}, 0.0).empty());
  map.reset();
  EXPECT_TRUE(map.things({0, 0}, 0.0).empty());
}

TEST(Occupancy, FarReadingsCountLess) {
  OccupancyMap map;
  map.add(trunk(3.0, 0.0), {0, 0}, 0.0);
  const double near = map.evidence({3.1, 0.0});
  map.reset();
  map.add(trunk(8.0, 0.0), {0, 0}, 0.0);
  EXPECT_NEAR(map.evidence({8.1, 0.0}), near * OccupancyOptions{}.sure_m / 8.0, 0.05);
}

TEST(Occupancy, SaturatedReadingsMarkAndClearNothing) {
  // What was seen at 1.2 m must stand when, nearer still, it reads as if it stood at 2.5 m.
  OccupancyMap map;
  for (int i = 0; i < 5; ++i) {
    map.add(trunk(1.2, 0.0), {0, 0}, 0.0);
  }
  const double before = map.evidence({1.3, 0.0});
  ASSERT_GT(before, OccupancyOptions{}.blocked);
  HorizonScan far;
  far.things.emplace_back(2.5, 0.0);
  HorizonScan saturated;
  saturated.near = far.things;
  for (int i = 0; i < 10; ++i) {
    map.add(saturated, {0, 0}, 0.0);
  }
  EXPECT_EQ(map.evidence({1.3, 0.0}), before);
  EXPECT_GT(map.evidence({2.6, 0.0}), OccupancyOptions{}.blocked);
  for (int i = 0; i < 30; ++i) {
    map.add(far, {0, 0}, 0.0);
  }
  EXPECT_LT(map.evidence({1.3, 0.0}), 0.0) << "a reading that can be trusted clears the way to it";
}

TEST(Occupancy, ForgetsAsItMovesAndNothingAtRest) {
  const OccupancyOptions options;
  OccupancyMap map;
  map.add(trunk(3.0, 0.0), {0, 0}, 0.0);
  const double before = map.evidence({3.1, 0.0});
  map.add(HorizonScan{}, {0.0, 2.0}, 0.0);
  EXPECT_NEAR(map.evidence({3.1, 0.0}), before * std::exp(-2.0 / options.forget_m), 1e-6);
  const double then = map.evidence({3.1, 0.0});
  for (int i = 0; i < 1000; ++i) {
    map.add(HorizonScan{}, {0.0, i % 2 == 0 ? 1.95 : 2.05}, 0.0);  // hovers
  }
  EXPECT_EQ(map.evidence({3.1, 0.0}), then) << "what it has braked for must not be forgotten at rest";
  // So far away that its cells have been used for other places.
  map.add(nothing(), {500.0, 0.0}, 0.0);
  EXPECT_NEAR(map.evidence({3.1, 0.0}), 0.0, 1e-9);
}

TEST(Occupancy, OptionsOutOfRangeAreNamed) {
  OccupancyOptions options;
  options.cell_m = 0.0;
  EXPECT_THROW(OccupancyMap{options}, Error);
  options = {};
  options.blocked = options.bound + 1.0;
  EXPECT_THROW(OccupancyMap{options}, Error);
  CorridorOptions corridor;
  corridor.support = 0;
  EXPECT_THROW(CorridorPlanner{corridor}, Error);
}

}  // namespace
}  // namespace ajna::tasks
