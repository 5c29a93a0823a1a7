// SPDX-License-Identifier: MIT
// Which side is taken, and kept to.
#include <gtest/gtest.h>

#include "ajna/base/error.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/navigate.hpp"
#include "task_maps.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFrame = 1.0 / 30.0;

TEST(Dodge, RisingThingsAreLeftSideways) {
  // Up and a little to the right: what was thrown rises before it falls, so only the side counts.
  DodgeOptions options;
  options.direct_hit = 0.0;
  const auto direction = [&] {
    DodgePipeline pipeline(options);
    DodgeResult result;
    for (int i = 0; i < 3; ++i) {
      result = pipeline.step(with_disc(calm_map(), {160 + 3 * i, 150 - 9 * i}, 12, 1.6), i * kFrame);
    }
    EXPECT_TRUE(result.safe_direction.has_value());
    return result.safe_direction.value_or(Eigen::Vector2d::Zero());
  };
  EXPECT_NEAR(direction().x(), -1.0, 1e-9);
  options.vertical = 1.0;
  EXPECT_GT(direction().y(), 0.8);
  options.vertical = 1.5;
  EXPECT_THROW(validate(options), Error);
}

TEST(Navigate, KeepsToTheSideItHasChosen) {
  NavigatePipeline pipeline;
  const double right = pipeline.step(trunk(130, 30, 2.0), 0.0).free_px.x();
  ASSERT_GT(right, 160);
  EXPECT_GT(pipeline.step(trunk(155, 30, 2.0), kFrame).free_px.x(), 160);      // a little less room there now
  EXPECT_LT(pipeline.step(trunk(190, 30, 2.0), 2 * kFrame).free_px.x(), 160);  // far less
}

TEST(Navigate, TheGroundBelowTheWindowSetsNoThreshold) {
  cv::Mat map = trunk(130, 30, 0.9);
  map.rowRange(185, kHeight).setTo(3.0);
  NavigatePipeline pipeline;
  const NavigateResult result = pipeline.step(map, 0.0);
  ASSERT_EQ(result.status, NavigateStatus::kOk);
  EXPECT_EQ(result.free.mask.at<std::uint8_t>(120, 145), 0);
  EXPECT_GT(result.free_px.x(), 160);
}

TEST(Navigate, WhatUncertaintySurroundsIsFree) {
  cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(1.5));  // straight ahead nothing moves, all around does
  cv::circle(map, {160, 120}, 50, 0.2, cv::FILLED);
  NavigatePipeline pipeline;
  const NavigateResult result = pipeline.step(map, 0.0);
  ASSERT_EQ(result.status, NavigateStatus::kOk);
  EXPECT_NEAR(result.free_px.x(), 160, 5);
}

}  // namespace
}  // namespace ajna::tasks
