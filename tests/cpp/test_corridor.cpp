// SPDX-License-Identifier: MIT
// The choice of a corridor on the map of what many frames have shown.
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>
#include <optional>

#include "ajna/base/error.hpp"
#include "ajna/tasks/corridor.hpp"
#include "horizon_scans.hpp"

namespace ajna::tasks {
namespace {

using Eigen::Vector2d;

/// Several frames from one place.
Corridor seen(CorridorPlanner& planner, const HorizonScan& scan, double goal_rad = 0.0, int frames = 5) {
  Corridor corridor;
  for (int i = 0; i < frames; ++i) {
    corridor = planner.plan(scan, {0, 0}, 0.0, goal_rad);
  }
  return corridor;
}

TEST(Corridor, StraightToTheGoalWhereNothingStands) {
  CorridorPlanner planner;
  const Corridor corridor = planner.plan(nothing(), {0, 0}, 0.0, 0.3);
  EXPECT_NEAR(corridor.angle_rad, 0.3, 0.02);
  EXPECT_EQ(corridor.free_m, planner.options().horizon_m);
  EXPECT_EQ(corridor.goal_free_m, planner.options().horizon_m);
  EXPECT_GT(corridor.speed_m_s, 5.5);
  CorridorPlanner blind;
  EXPECT_NEAR(blind.plan(std::nullopt, {0, 0}, 0.0, 0.3).angle_rad, 0.3, 0.02) << "nothing is known yet";
}

TEST(Corridor, PassesATrunkOnItsFreeSide) {
  for (const double side : {-1.0, 1.0}) {
    CorridorPlanner planner;
    const Corridor corridor = seen(planner, trunk(4.0, 0.2 * side));
    EXPECT_LT(corridor.angle_rad * side, -0.1);
    // At the trunk the corridor's edge is beyond the trunk's, but for half a cell.
    EXPECT_LT(4.0 * std::tan(corridor.angle_rad) * side + planner.options().half_width_m, 0.2 - 0.3 + 0.11);
    EXPECT_LT(corridor.goal_free_m, 4.0);  // as wide as it is, the vehicle touches before its centre is there
    EXPECT_GT(corridor.goal_free_m, 4.0 - planner.options().half_width_m - 0.1);
    EXPECT_EQ(corridor.free_m, planner.options().horizon_m);
    EXPECT_FALSE(planner.things().empty());
  }
}

TEST(Corridor, KeepsItsSide) {
  CorridorPlanner planner;
  ASSERT_LT(seen(planner, trunk(4.0, 0.1)).angle_rad, 0.0);
  EXPECT_LT(planner.plan(trunk(3.9, -0.1), {0.1, 0}, 0.0, 0.0).angle_rad, 0.0) << "the other side is no better";
  planner.reset();
  EXPECT_GT(seen(planner, trunk(3.9, -0.1)).angle_rad, 0.0);
}

TEST(Corridor, KnowsWhatHasLeftThePicture) {
  CorridorPlanner planner;
  seen(planner, trunk(1.5, 0.6));
  // A metre further, and turned to the left by 0.3: the trunk stands on the way to the goal, out of the picture.
  const Corridor later = planner.plan(std::nullopt, {1.0, 0.0}, -0.3, 1.1);
  EXPECT_LT(later.goal_free_m, 1.2);
  planner.plan(nothing(), {20.0, 0.0}, 0.0, 0.0);
  EXPECT_TRUE(planner.things().empty()) << "passed";
}

TEST(Corridor, AWayThatCannotBeFlownAtThisSpeedIsNotFree) {
  // A trunk a metre and a half ahead, a little to the right. At rest one turns to the left of it and is through; at
  // 5 m/s the vehicle would be in it before it has turned.
  CorridorPlanner planner;
  const HorizonScan scan = trunk(1.5, 0.2);
  const Corridor slow = seen(planner, scan);
  EXPECT_LT(slow.angle_rad, 0.0);
  EXPECT_EQ(slow.free_m, planner.options().horizon_m);
  planner.reset();
  Corridor fast;
  for (int i = 0; i < 5; ++i) {
    fast = planner.plan(scan, {0, 0}, 0.0, 0.0, {{5.0, 0.0}});
  }
  EXPECT_LT(fast.free_m, 2.0);
  EXPECT_LT(fast.speed_m_s, slow.speed_m_s);
  // From further away the way round it is free at that speed, too.
  planner.reset();
  for (int i = 0; i < 5; ++i) {
    fast = planner.plan(trunk(5.0, 0.2), {0, 0}, 0.0, 0.0, {{5.0, 0.0}});
  }
  EXPECT_LT(fast.angle_rad, 0.0);
  EXPECT_EQ(fast.free_m, planner.options().horizon_m);
}

TEST(Corridor, BeginsWhereTheCommandWillFindTheVehicle) {
  const CorridorStart later{{4.0, 0.6}, {1.0, 0.3}};
  CorridorPlanner planner, there;
  seen(planner, trunk(5.0, 0.2));
  seen(there, trunk(5.0, 0.2));
  CorridorPlanner unaware = planner;
  const Corridor ahead = planner.plan(std::nullopt, {0, 0}, 0.0, 0.0, later);
  const Corridor same = there.plan(std::nullopt, later.moved_m, 0.0, 0.0, {later.velocity_m_s});
  EXPECT_NEAR(ahead.angle_rad, same.angle_rad, 0.06) << "within a cell of the map";
  EXPECT_NEAR(ahead.free_m, same.free_m, 0.3);
  EXPECT_NEAR(ahead.speed_m_s, same.speed_m_s, 0.3);
  const Corridor late = unaware.plan(std::nullopt, {0, 0}, 0.0, 0.0, {later.velocity_m_s});
  EXPECT_GT(std::abs(ahead.angle_rad - late.angle_rad), 0.12) << "what is nearer is turned away from more";
}

TEST(Corridor, ChoosesAtAnySpeed) {
  for (const double speed : {5.0, 8.0, 10.0}) {  // at the last two its least way is longer than need_m
    CorridorPlanner planner;
    Corridor corridor;
    for (int i = 0; i < 5; ++i) {
      corridor = planner.plan(trunk(4.5, 0.2), {0, 0}, 0.0, 0.0, {{speed, 0.0}});
    }
    EXPECT_LT(corridor.angle_rad, -0.1) << speed;
  }
}

TEST(Corridor, GoesOnFromBesideAThing) {
  // 0.3 m to the left stands something, nearer than half the corridor's width: that must not hold it for ever.
  CorridorPlanner planner;
  HorizonScan scan = nothing();
  for (int i = 0; i < 20; ++i) {
    scan.things.emplace_back(0.02 * i, -0.3);
  }
  const Corridor corridor = seen(planner, scan, 0.0, 10);
  ASSERT_FALSE(planner.things().empty());
  EXPECT_GT(corridor.free_m, 3.0);
  EXPECT_GE(corridor.angle_rad, 0.0) << "and not nearer to it";
}

TEST(Corridor, LooksToTheSidesWhereTheFanIsBlocked) {
  // At rest before a thing as wide as the fan; to its right, beyond the fan, the way is free.
  const double fan = CorridorOptions{}.fan_rad;
  HorizonScan scan;
  for (double angle = -1.5; angle <= fan + 0.1; angle += 0.01) {
    scan.things.emplace_back(0.6 * std::cos(angle), 0.6 * std::sin(angle));
  }
  CorridorPlanner planner;
  const Corridor corridor = seen(planner, scan);
  EXPECT_GT(corridor.angle_rad, fan);
  EXPECT_LE(corridor.angle_rad, planner.options().wide_fan_rad);
  EXPECT_GT(corridor.free_m, planner.options().blocked_m);
  CorridorOptions narrow;
  narrow.wide_fan_rad = fan;
  CorridorPlanner stuck(narrow);
  EXPECT_LT(seen(stuck, scan).free_m, planner.options().blocked_m);
  planner.reset();
  Corridor moving;
  for (int i = 0; i < 5; ++i) {
    moving = planner.plan(scan, {0, 0}, 0.0, 0.0, {{2.0, 0.0}});
  }
  EXPECT_LE(moving.angle_rad, fan + 1e-9) << "a vehicle under way does not turn to what it does not see";
  narrow.wide_fan_rad = 4.0;
  EXPECT_THROW(CorridorPlanner{narrow}, Error);
}

TEST(Corridor, ADriftTowardsAThingDoesNotBlockTheWaysPastIt) {
  // It has braked before a trunk that stands 0.4 m ahead, and still drifts nearer.
  HorizonScan scan;
  for (double angle = -0.6; angle <= 0.6; angle += 0.02) {
    scan.things.emplace_back(0.4, 0.4 * std::tan(angle));
  }
  CorridorPlanner planner;
  Corridor corridor;
  for (int i = 0; i < 5; ++i) {
    corridor = planner.plan(scan, {0, 0}, 0.0, 0.0, {{0.3, 0.0}});
  }
  EXPECT_GT(std::abs(corridor.angle_rad), planner.options().fan_rad);
  EXPECT_GT(corridor.free_m, planner.options().blocked_m);
  EXPECT_LT(corridor.goal_free_m, 0.5);
}

/// How near the vehicle's middle comes to a thing 0.6 m long beside it, when it flies as it is told, 30 times a second.
double nearest_of_a_flight_past(double crowd_weight) {
  CorridorOptions options;
  options.crowd_weight = crowd_weight;
  options.camera_ahead_m = 0.0;
  CorridorPlanner planner(options);
  HorizonScan scan = nothing();
  for (int i = 0; i <= 30; ++i) {
    scan.things.emplace_back(0.8 + 0.02 * i, 0.5);
  }
  seen(planner, scan, 0.0, 10);
  Vector2d at(0, 0);
  double yaw = 0.0;
  double nearest = 1e9;
  for (int i = 0; i < 60; ++i) {
    const Corridor corridor =
        planner.plan(std::nullopt, at, yaw, 0.8 - yaw, {{1.5, 0.0}});  // the goal: round the corner
    yaw += 0.15 * corridor.angle_rad;
    at += 0.05 * Vector2d(std::cos(yaw), std::sin(yaw));
    for (const auto& thing : scan.things) {
      nearest = std::min(nearest, (thing - at).norm());
    }
  }
  EXPECT_GT(at.y(), 0.5) << "it did go round the corner";
  return nearest;
}

TEST(Corridor, KeepsFurtherFromWhatItPasses) {
  // This one turns on the spot, which no vehicle does; it shows what the choice of directions by itself is worth.
  EXPECT_GT(nearest_of_a_flight_past(CorridorOptions{}.crowd_weight), nearest_of_a_flight_past(0.0) + 0.02);
}

TEST(Corridor, FliesThroughTheMiddleOfAGap) {
  CorridorPlanner planner;
  HorizonScan scan = trunk(2.0, -1.0, 0.6);
  const HorizonScan other = trunk(2.0, 0.6, 0.6);
  scan.things.insert(scan.things.end(), other.things.begin(), other.things.end());
  const Corridor corridor = seen(planner, scan, 0.0, 10);
  EXPECT_LT(corridor.angle_rad, 0.0) << "the goal's own line would pass nearer to the right one";
  EXPECT_GT(corridor.angle_rad, -0.2);
}

/// A wall across the way, from one side to the other, with a gap in its middle.
HorizonScan wall(double forward_m, double gap_m) {
  HorizonScan scan;
  for (double right = gap_m / 2.0; right < 7.0; right += 0.05) {
    scan.things.emplace_back(forward_m, right);
    scan.things.emplace_back(forward_m, -right);
  }
  return scan;
}

TEST(Corridor, SqueezesSlowlyThroughWhatIsHardlyWiderThanTheVehicle) {
  CorridorOptions options;
  options.half_width_m = 0.6;
  CorridorPlanner planner(options);
  const Corridor corridor = seen(planner, wall(2.0, 0.8), 0.0, 10);
  ASSERT_LT(corridor.free_m, 2.0) << "0.8 m: too narrow to pass with room to spare";
  EXPECT_GT(corridor.bare_m, 4.0);
  EXPECT_GE(corridor.speed_m_s, planner.options().squeeze_m_s);
  EXPECT_NEAR(corridor.angle_rad, 0.0, 0.1);
}

TEST(Corridor, SlowsDownBeforeADeadEnd) {
  HorizonScan scan = wall(1.3, 0.0);
  for (double forward = -1.0; forward < 1.3; forward += 0.05) {
    scan.things.emplace_back(forward, 1.0);
    scan.things.emplace_back(forward, -1.0);
  }
  CorridorOptions no_squeezing;
  no_squeezing.squeeze_m_s = 0.0;
  CorridorPlanner planner(no_squeezing);
  seen(planner, scan);
  const Corridor corridor = planner.plan(scan, {0, 0}, 0.0, 0.0, {{2.0, 0.0}});
  EXPECT_LT(corridor.free_m, 1.3);
  // What it flies until it brakes, and while it does, is what is left.
  const CorridorOptions& options = planner.options();
  const double speed = corridor.speed_m_s;
  EXPECT_NEAR(speed * (options.lag_s + 1.0 / options.turn_per_s) + speed * speed / (2.0 * options.brake_m_s2),
              corridor.free_m - options.stop_m, 1e-9);
}

TEST(Corridor, ChoosesTheSideThatLeadsOn) {
  // Straight on stands a trunk; to its left the way ends 2 m behind it, to its right it leads on. What is free first
  // says nothing of that.
  HorizonScan scan = trunk(2.0, 0.0);
  for (double forward = 1.0; forward < 4.0; forward += 0.05) {
    scan.things.emplace_back(forward, -1.6);
  }
  for (double right = -1.6; right < 0.3; right += 0.05) {
    scan.things.emplace_back(4.0, right);
  }
  CorridorPlanner planner;
  EXPECT_GT(seen(planner, scan, 0.0, 10).angle_rad, 0.05);
  planner.reset();
  for (auto& thing : scan.things) {
    thing.y() = -thing.y();
  }
  EXPECT_LT(seen(planner, scan, 0.0, 10).angle_rad, -0.05);
}

TEST(Corridor, FliesPastAThingNoFasterThanItSees) {
  // The goal lies aside, outside of the picture: what stands there is not known, and the vehicle must not speed up.
  CorridorPlanner planner;
  const Corridor aside = planner.plan(nothing(), {0, 0}, 0.0, 1.5, {{1.5, 0.0}});
  EXPECT_NEAR(aside.angle_rad, planner.options().fan_rad, 0.05);
  EXPECT_NEAR(aside.speed_m_s, 1.5, 0.5);
  planner.reset();
  EXPECT_GT(planner.plan(nothing(), {0, 0}, 0.0, 0.0, {{1.5, 0.0}}).speed_m_s, 4.0);
  // Touching something it goes on slowly, wherever that leads.
  HorizonScan scan = nothing();
  for (int i = 0; i < 20; ++i) {
    scan.things.emplace_back(0.02 * i, -0.25);
  }
  planner.reset();
  const Corridor touching = seen(planner, scan, 0.0, 10);
  ASSERT_FALSE(planner.things().empty());
  EXPECT_LE(touching.speed_m_s, planner.options().squeeze_m_s);
}

}  // namespace
}  // namespace ajna::tasks
