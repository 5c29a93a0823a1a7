// SPDX-License-Identifier: MIT
// The policy of a vehicle whose commands act late: it counts on those that have not acted yet.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "ajna/control/policies.hpp"

namespace ajna::control {
namespace {

using Eigen::Vector3d;

/// How far the velocity still is from the wanted one, on average over the fourth and fifth second, m/s, after a turn by
/// half a radian, where commands are given at 8 Hz and each acts `late` steps of 1/60 s later, on a vehicle that
/// follows them exactly.
double unrest(const NavigatePolicyOptions& options, int late) {
  constexpr double kStep = 1.0 / 60.0;
  constexpr double kDirection = 0.5;
  NavigatePolicy policy(options);
  double heading = 0.0;
  Vector3d velocity(options.speed_m_s, 0.0, 0.0);  // axes that do not turn
  std::vector<Command> given(1, Command::hold());
  double sum = 0.0;
  for (int i = 0; i < 300; ++i) {
    const Eigen::AngleAxisd turn(heading, Vector3d::UnitZ());
    if (i % 8 == 0) {
      Guidance guidance;
      guidance.free = Vector3d(std::cos(kDirection - heading), std::sin(kDirection - heading), 0.0);
      guidance.weight = 1.0;
      guidance.speed_m_s = options.speed_m_s;
      given.insert(given.end(), 8, policy.update(guidance, i * kStep, turn.inverse() * velocity));
    }
    const auto& acting = given[static_cast<std::size_t>(std::max(0, i + 1 - late))];
    velocity += kStep * (turn * acting.acceleration_m_s2);
    heading += kStep * acting.yaw_rate_rad_s;
    const Vector3d wanted = options.speed_m_s * Vector3d(std::cos(kDirection), std::sin(kDirection), 0.0);
    sum += i >= 180 ? (velocity - wanted).norm() / 120.0 : 0.0;
  }
  return sum;
}

TEST(Navigate, ALateLoopThatKnowsItsDelaySwingsLess) {
  NavigatePolicyOptions options;
  options.weave = 0.0;
  for (const int late : {0, 4, 16, 24, 32}) {
    options.delay_s = 0.0;
    const double unaware = unrest(options, late);
    options.delay_s = (late + 4) / 60.0;  // half the time to the next command with it
    const double aware = unrest(options, late);
    EXPECT_LT(aware, 0.05) << late << " steps late";
    if (late >= 24) {
      EXPECT_GT(unaware, 0.3) << "0.4 s and more: it swings";
    }
  }
}

TEST(Navigate, KnowsWhereCommandsOnTheirWayWillTakeIt) {
  NavigatePolicyOptions options;
  options.delay_s = 0.137;
  NavigatePolicy policy(options);
  EXPECT_EQ(policy.pending(0.0).moved_m, Vector3d::Zero()) << "nothing was given yet";
  std::vector<std::pair<double, Command>> given;
  for (const double time_s : {0.0, 0.04, 0.1, 0.133, 0.17, 0.25}) {
    Guidance guidance;
    guidance.free = {std::cos(8.0 * time_s), std::sin(8.0 * time_s), 0.0};
    guidance.weight = 1.0;
    given.emplace_back(time_s, policy.update(guidance, time_s, Vector3d(1.0, 0.5, 0.0)));
  }
  const double now_s = 0.28;
  // Step by step: what was given a delay before each moment acts in it.
  constexpr double kStep_s = 1e-5;
  Vector3d gained = Vector3d::Zero(), moved = Vector3d::Zero();
  double turned = 0.0;
  for (double t = now_s - options.delay_s; t < now_s; t += kStep_s) {
    const auto next = std::find_if(given.begin(), given.end(), [&](const auto& one) { return one.first > t; });
    const Command& acting = std::prev(next)->second;
    gained += kStep_s * acting.acceleration_m_s2;
    moved += kStep_s * gained;
    turned += kStep_s * acting.yaw_rate_rad_s;
  }
  const auto pending = policy.pending(now_s);
  EXPECT_GT(gained.norm(), 0.05);
  EXPECT_NEAR((pending.gained_m_s - gained).norm(), 0.0, 1e-3);
  EXPECT_NEAR((pending.moved_m - moved).norm(), 0.0, 1e-4);
  EXPECT_NEAR(pending.turned_rad, turned, 1e-3);
}

}  // namespace
}  // namespace ajna::control
