// SPDX-License-Identifier: MIT
// The controller's step response and the limits and signs of the policies.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/control/pid.hpp"
#include "ajna/control/policies.hpp"

namespace ajna::control {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

PidOptions gains(double kp, double ki, double kd) {
  PidOptions options;
  options.kp = kp;
  options.ki = ki;
  options.kd = kd;
  return options;
}

TEST(Pid, ConstantErrorGivesProportionPlusRamp) {
  Pid pid(gains(2.0, 0.5, 3.0));
  EXPECT_DOUBLE_EQ(pid.update(1.0, 0.1), 2.0);  // the first step has no past
  for (int i = 1; i <= 10; ++i) {
    EXPECT_NEAR(pid.update(1.0, 0.1), 2.0 + 0.05 * i, 1e-12);
  }
}

TEST(Pid, DerivativeOfARampSettlesThroughItsFilter) {
  PidOptions options = gains(0.0, 0.0, 1.0);
  options.derivative_cutoff_hz = 5.0;
  Pid pid(options);
  const double dt = 0.01, slope = 3.0;
  const double keep = 1.0 - dt / (1.0 / (2.0 * M_PI * 5.0) + dt);
  pid.update(0.0, dt);
  for (int i = 1; i <= 20; ++i) {
    EXPECT_NEAR(pid.update(slope * dt * i, dt), slope * (1.0 - std::pow(keep, i)), 1e-9);
  }
}

TEST(Pid, StepResponseOfAPlantSettlesWithoutSteadyError) {
  // x' = u - 0.3 (a constant disturbance): the integral must remove the offset.
  PidOptions options = gains(2.0, 1.5, 0.1);
  options.output_min = -1.0;
  options.output_max = 1.0;
  Pid pid(options);
  double x = 0.0, largest = 0.0;
  for (int i = 0; i < 4000; ++i) {
    const double u = pid.update(1.0 - x, 0.01);
    ASSERT_LE(std::abs(u), 1.0);
    x += 0.01 * (u - 0.3);
    largest = std::max(largest, x);
  }
  EXPECT_NEAR(x, 1.0, 1e-3);
  EXPECT_LT(largest, 1.35);
}

TEST(Pid, DoesNotWindUp) {
  PidOptions options = gains(1.0, 2.0, 0.0);
  options.output_max = 1.0;
  options.output_min = -1.0;
  Pid pid(options);
  for (int i = 0; i < 1000; ++i) {
    pid.update(5.0, 0.1);
  }
  EXPECT_LE(pid.integral(), 1.0);
  // 500 s of saturation must not delay the way back: a small opposite error leaves the limit at once.
  EXPECT_LT(pid.update(-0.5, 0.1), 1.0);
}

TEST(Pid, BadStepsRepeatTheLastOutput) {
  Pid pid(gains(1.0, 1.0, 0.1));
  pid.update(0.2, 0.1);
  const double before = pid.update(0.4, 0.1), integral = pid.integral();
  for (const double dt : {0.0, -0.1, kNaN, std::numeric_limits<double>::infinity()}) {
    EXPECT_EQ(pid.update(1.0, dt), before);
  }
  EXPECT_EQ(pid.update(kNaN, 0.1), before);
  EXPECT_EQ(pid.integral(), integral);
  EXPECT_DOUBLE_EQ(pid.update(0.3, 10.0), 0.3);  // a gap: proportional only
  pid.reset();
  EXPECT_EQ(pid.output(), 0.0);
}

TEST(Pid, RefusesImpossibleOptions) {
  EXPECT_THROW(Pid(gains(-1.0, 0.0, 0.0)), Error);
  EXPECT_THROW(Pid(gains(kNaN, 0.0, 0.0)), Error);
  PidOptions options;
  options.output_min = options.output_max = 1.0;
  EXPECT_THROW(Pid{options}, Error);
}

TEST(Dodge, GoesTheSafeWayHoldsItAndThenStops) {
  DodgePolicyOptions options;
  DodgePolicy policy(options);
  EXPECT_EQ(policy.update(std::nullopt, 0.0).mode, CommandMode::kHold);
  const Command left = policy.update(Vector2d(-2.0, 0.0), 0.1);
  EXPECT_EQ(left.mode, CommandMode::kAcceleration);
  EXPECT_NEAR(left.velocity_m_s.y(), -options.speed_m_s, 1e-12);
  EXPECT_NEAR(left.acceleration_m_s2.y(), -options.burst_m_s2, 1e-12);
  EXPECT_EQ(left.velocity_m_s.x(), 0.0);
  // Neither a change of mind nor a missed detection turns it round.
  EXPECT_LT(policy.update(Vector2d(1.0, 0.0), 0.2).velocity_m_s.y(), 0.0);
  EXPECT_LT(policy.update(std::nullopt, 0.3).velocity_m_s.y(), 0.0);
  EXPECT_EQ(policy.update(std::nullopt, 0.1 + options.hold_s + 0.01).mode, CommandMode::kHold);
  EXPECT_FALSE(policy.dodging());
}

TEST(Dodge, BurstsUntilItsSpeedIsDueAndThenFollowsIt) {
  DodgePolicyOptions options;
  DodgePolicy policy(options);
  const double due_s = options.speed_m_s / options.burst_m_s2;
  const Command sunk = policy.update(Vector2d(0.0, 1.0), 0.0);
  EXPECT_NEAR(sunk.acceleration_m_s2.z() * due_s, options.max_down_m_s, 1e-12) << "no faster than it may sink";
  EXPECT_EQ(policy.update(std::nullopt, 0.9 * due_s).mode, CommandMode::kAcceleration);
  EXPECT_EQ(policy.update(std::nullopt, 1.1 * due_s).mode, CommandMode::kVelocity);
  options.burst_m_s2 = 0.0;
  EXPECT_EQ(DodgePolicy(options).update(Vector2d(1.0, 0.0), 0.0).mode, CommandMode::kVelocity);
}

TEST(Dodge, EndsWhateverTheMovingCameraSees) {
  const DodgePolicyOptions options;
  DodgePolicy policy;
  constexpr double kFrame_s = 1.0 / 30.0;
  double moving_s = 0.0;
  double longest_s = 0.0;
  double still_s = 0.0;
  bool again = false;
  for (int i = 0; i < 60; ++i) {
    const bool holds = policy.update(Vector2d(1.0, 0.0), i * kFrame_s).mode == CommandMode::kHold;
    again = again || (!holds && still_s > 0.0);
    moving_s = holds ? 0.0 : moving_s + kFrame_s;
    longest_s = std::max(longest_s, moving_s);
    if (holds && !again) {
      still_s += kFrame_s;
    }
  }
  EXPECT_NEAR(longest_s, options.longest_s, 2.0 * kFrame_s);
  EXPECT_NEAR(still_s, options.settle_s, 2.0 * kFrame_s);
  EXPECT_TRUE(again) << "what still comes then is dodged anew";
}

TEST(Dodge, DescendsSlowlyAndIgnoresNonsense) {
  DodgePolicy policy;
  const Command down = policy.update(Vector2d(0.0, 1.0), 1.0);
  EXPECT_DOUBLE_EQ(down.velocity_m_s.z(), DodgePolicyOptions{}.max_down_m_s);
  EXPECT_EQ(policy.update(std::nullopt, 0.5).velocity_m_s, down.velocity_m_s);  // out of order: repeats
  policy.reset();
  EXPECT_EQ(policy.update(Vector2d(kNaN, 0.0), 0.0).mode, CommandMode::kHold);
  EXPECT_EQ(policy.update(Vector2d(0.0, 0.0), 0.1).mode, CommandMode::kHold);
}

TEST(Navigate, Equation3) {
  Guidance guidance;
  guidance.free = Vector3d(1.0, 1.0, 0.0);
  EXPECT_LT((desired_direction(guidance) - Vector3d::UnitX()).norm(), 1e-12);
  guidance.weight = 1.0;
  EXPECT_LT((desired_direction(guidance) - Vector3d(1, 1, 0).normalized()).norm(), 1e-12);
  guidance.weight = 0.5;
  const Vector3d half = 0.5 * Vector3d::UnitX() + 0.5 * Vector3d(1, 1, 0).normalized();
  EXPECT_LT((desired_direction(guidance) - half.normalized()).norm(), 1e-12);
  guidance.free = -guidance.goal;
  EXPECT_EQ(desired_direction(guidance), guidance.goal);
  guidance.weight = 1.5;
  EXPECT_THROW(desired_direction(guidance), Error);
  guidance.weight = kNaN;
  EXPECT_THROW(desired_direction(guidance), Error);
}

TEST(Navigate, TurnsAndPushesTowardsTheDesiredDirection) {
  NavigatePolicyOptions options;
  NavigatePolicy policy(options);
  Guidance right;
  right.free = Vector3d(1.0, 0.8, -0.2);
  right.weight = 1.0;
  const Command command = policy.update(right, 0.0);
  EXPECT_EQ(command.mode, CommandMode::kAcceleration);
  EXPECT_GT(command.yaw_rate_rad_s, 0.0);
  EXPECT_LE(command.yaw_rate_rad_s, options.yaw.output_max);
  EXPECT_GT(command.acceleration_m_s2.y(), 0.0);
  EXPECT_LT(command.acceleration_m_s2.z(), 0.0);
  EXPECT_LE(command.acceleration_m_s2.norm(), options.max_acceleration_m_s2 + 1e-12);
  EXPECT_NEAR(command.velocity_m_s.norm(), options.speed_m_s * (1.0 - options.slow_down), 1e-12);
  EXPECT_LT(command.thrust_m_s2().z(), -9.0);  // up, against gravity
}

TEST(Navigate, MeasuredVelocityClosesTheLoop) {
  NavigatePolicyOptions options;
  options.weave = 0.0;
  NavigatePolicy policy(options);
  const double speed = options.speed_m_s;
  const Command steady = policy.update(Guidance{}, 0.0, Vector3d(speed, 0, 0));
  EXPECT_LT(steady.acceleration_m_s2.norm(), 1e-12);
  policy.reset();
  EXPECT_GT(policy.update(Guidance{}, 0.0, Vector3d::Zero()).acceleration_m_s2.x(), 0.0);
}

TEST(Navigate, LeansForwardNoFurtherThanItSees) {
  const NavigatePolicyOptions options;
  NavigatePolicy policy;
  Guidance guidance;
  double most = 0.0;
  for (double t = 0.0; t < 1.0; t += 0.033) {
    most = std::max(most, policy.update(guidance, t, Vector3d::Zero()).acceleration_m_s2.x());
  }
  EXPECT_NEAR(most, std::min(options.max_forward_m_s2, options.speed_m_s / options.speed_up_s), 1e-9);
  // Braking is limited by the whole acceleration only.
  guidance.speed_m_s = 0.0;
  double least = 0.0;
  for (double t = 1.0; t < 2.0; t += 0.033) {
    least = std::min(least, policy.update(guidance, t, Vector3d(options.speed_m_s, 0, 0)).acceleration_m_s2.x());
  }
  EXPECT_LT(least, -options.max_forward_m_s2 - 1.0);
}

/// The largest sideways speed of a point that follows the policy for some seconds, first in a straight line.
double swing(const NavigatePolicyOptions& options, const Guidance& guidance, bool measured) {
  NavigatePolicy policy(options);
  Vector3d velocity = Vector3d::Zero();
  double most = 0.0;
  constexpr double kStep = 0.02;
  for (int i = 0; i < 500; ++i) {
    const auto seen = measured ? std::optional(velocity) : std::nullopt;
    velocity += kStep * policy.update(guidance, i * kStep, seen).acceleration_m_s2;
    most = i > 250 ? std::max(most, std::abs(velocity.y())) : most;
  }
  return most;
}

TEST(Navigate, WeavesWhileItFliesAndNotWhileItStands) {
  NavigatePolicyOptions options;
  Guidance guidance;
  EXPECT_GT(swing(options, guidance, true), 0.5 * options.weave * options.speed_m_s);
  EXPECT_LT(swing(options, guidance, true), 1.5 * options.weave * options.speed_m_s);
  EXPECT_LT(swing(options, guidance, false), 1e-9) << "without a measured velocity it could drift";
  const Vector3d no_number(kNaN, 0.0, 0.0);
  EXPECT_EQ(NavigatePolicy(options).update(guidance, 0.0, no_number).acceleration_m_s2.y(), 0.0) << "nor with that";
  guidance.speed_m_s = 0.0;
  EXPECT_LT(swing(options, guidance, true), 1e-9);
  guidance.speed_m_s.reset();
  options.weave = 0.0;
  EXPECT_LT(swing(options, guidance, true), 1e-9);
}

TEST(Navigate, HoldsWithoutAnswers) {
  NavigatePolicy policy;
  EXPECT_EQ(policy.update(std::nullopt, 0.0).mode, CommandMode::kHold);
  policy.update(Guidance{}, 0.1);
  EXPECT_EQ(policy.update(std::nullopt, 0.5).mode, CommandMode::kAcceleration);
  EXPECT_EQ(policy.update(std::nullopt, 0.1 + NavigatePolicyOptions{}.lookahead_s + 0.1).mode, CommandMode::kHold);
}

TEST(Explore, IsDiagonalOrAWobbleOfBoundedSpeed) {
  ExploreOptions options;
  const Command diagonal = explore(options, 0.1);
  EXPECT_NEAR(diagonal.velocity_m_s.norm(), options.speed_m_s, 1e-12);
  EXPECT_DOUBLE_EQ(diagonal.velocity_m_s.y(), -diagonal.velocity_m_s.z());
  EXPECT_EQ(explore(options, options.duration_s).mode, CommandMode::kHold);
  EXPECT_EQ(explore(options, kNaN).mode, CommandMode::kHold);
  options.kind = ExploreKind::kExcitedHover;
  double least = 0.0, most = 0.0;
  for (double t = 0.0; t < options.duration_s; t += 0.01) {
    const Vector3d v = explore(options, t).velocity_m_s;
    EXPECT_LE(v.norm(), options.speed_m_s + 1e-12);
    least = std::min(least, v.y());
    most = std::max(most, v.y());
  }
  EXPECT_LT(least, 0.0);
  EXPECT_GT(most, 0.0);
}

TEST(Gap, AlignsThenAdvancesThenCoasts) {
  const GapPolicyOptions options;
  GapPolicy policy(options);
  const Command aside = policy.update(Vector2d(0.4, -0.3), false, 0.0);
  EXPECT_EQ(aside.velocity_m_s.x(), 0.0);
  EXPECT_GT(aside.velocity_m_s.y(), 0.0);
  EXPECT_LT(aside.velocity_m_s.z(), 0.0);
  EXPECT_LE(std::abs(aside.velocity_m_s.y()), options.servo.output_max);
  EXPECT_GT(policy.update(Vector2d(0.05, 0.0), false, 0.1).velocity_m_s.x(), 0.0);
  EXPECT_GT(policy.update(Vector2d(0.2, 0.0), false, 0.2).velocity_m_s.x(), 0.0);  // hysteresis
  EXPECT_EQ(policy.update(Vector2d(0.3, 0.0), false, 0.3).velocity_m_s.x(), 0.0);
  EXPECT_EQ(policy.update(std::nullopt, true, 0.4).velocity_m_s, Vector3d(options.coast_m_s, 0, 0));
  EXPECT_FALSE(policy.finished());
  EXPECT_EQ(policy.update(std::nullopt, true, 0.5 + options.coast_duration_s).mode, CommandMode::kHold);
  EXPECT_TRUE(policy.finished());
}

TEST(Gap, HoldsWhereTheGapIsLost) {
  GapPolicy policy;
  policy.update(Vector2d(0.05, 0.0), false, 0.0);
  EXPECT_EQ(policy.update(std::nullopt, false, 0.1).mode, CommandMode::kVelocity);
  EXPECT_EQ(policy.update(std::nullopt, false, 0.1 + GapPolicyOptions{}.lost_hold_s).mode, CommandMode::kHold);
  EXPECT_EQ(policy.update(Vector2d(kNaN, 0.0), false, 5.0).mode, CommandMode::kHold);
}

TEST(Policies, RefuseImpossibleOptions) {
  DodgePolicyOptions dodge;
  dodge.speed_m_s = 0.0;
  EXPECT_THROW(DodgePolicy{dodge}, Error);
  dodge = {};
  dodge.longest_s = 0.0;
  EXPECT_THROW(DodgePolicy{dodge}, Error);
  NavigatePolicyOptions navigate;
  navigate.slow_down = 1.0;
  EXPECT_THROW(NavigatePolicy{navigate}, Error);
  navigate = {};
  navigate.max_forward_m_s2 = 0.0;
  EXPECT_THROW(NavigatePolicy{navigate}, Error);
  navigate = {};
  navigate.weave = -0.1;
  EXPECT_THROW(NavigatePolicy{navigate}, Error);
  navigate = {};
  navigate.delay_s = kNaN;
  EXPECT_THROW(NavigatePolicy{navigate}, Error);
  GapPolicyOptions gap;
  gap.realign = 0.01;
  EXPECT_THROW(GapPolicy{gap}, Error);
}

}  // namespace
}  // namespace ajna::control
