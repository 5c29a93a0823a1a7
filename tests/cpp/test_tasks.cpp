// SPDX-License-Identifier: MIT
// From maps of known content to masks, regions, points and states, and the answer to every map that has no content.
#include <gtest/gtest.h>

#include "ajna/base/error.hpp"
#include "ajna/base/flow_field.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/map_histogram.hpp"
#include "ajna/tasks/navigate.hpp"
#include "ajna/tasks/segment.hpp"
#include "task_maps.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFrame = 1.0 / 30.0;

// --- uncertainty map -------------------------------------------------------------------------------------------------

TEST(UncertaintyMap, ScalarKinds) {
  FlowField field;
  field.width = 2;
  field.height = 1;
  field.uncertainty = {3, 4, 5, 0};
  EXPECT_FLOAT_EQ(scalar_map(field).at<float>(0, 0), 5.0F);
  EXPECT_FLOAT_EQ(scalar_map(field, ScalarKind::kMax).at<float>(0, 0), 4.0F);
  EXPECT_FLOAT_EQ(scalar_map(field, ScalarKind::kX).at<float>(0, 1), 5.0F);
  EXPECT_FLOAT_EQ(scalar_map(field, ScalarKind::kY).at<float>(0, 1), 0.0F);
  field.uncertainty.pop_back();
  EXPECT_TRUE(scalar_map(field).empty());
}

TEST(UncertaintyMap, QuantilesOfARamp) {
  cv::Mat ramp(1, 1000, CV_32F);
  for (int i = 0; i < 1000; ++i) {
    ramp.at<float>(0, i) = static_cast<float>(i);
  }
  for (const double q : {0.0, 0.1, 0.5, 0.99, 1.0}) {
    EXPECT_NEAR(map_quantile(ramp, q), 1000 * q, 1.5) << q;
  }
  cv::Mat upper(1, 1000, CV_8U, cv::Scalar(0));
  upper.colRange(600, 1000).setTo(1);
  EXPECT_EQ(range_of(ramp, upper), std::pair(600.0, 999.0));
  EXPECT_NEAR(MapHistogram(ramp, upper).quantile(0.5), 800.0, 1.5);
  EXPECT_EQ(range_of(ramp, cv::Mat::zeros(1, 1000, CV_8U)), std::pair(0.0, 0.0));
  EXPECT_EQ(map_quantile(cv::Mat(3, 5, CV_32F, cv::Scalar(0.25F)), 0.9), 0.25);
  ramp.at<float>(0, 3) = std::numeric_limits<float>::infinity();
  EXPECT_EQ(map_quantile(ramp, 0.5), 0.0) << "no range: the least, and nothing written out of bounds";
}

TEST(UncertaintyMap, ConvexHullHoldsAllAndNoMore) {
  EXPECT_TRUE(convex_hull(cv::Mat::zeros(20, 20, CV_8U)).empty());
  cv::Mat mask = cv::Mat::zeros(60, 80, CV_8U);
  cv::ellipse(mask, {30, 25}, {20, 8}, 30, 0, 360, 255, 2);
  mask.at<std::uint8_t>(55, 70) = 255;
  std::vector<cv::Point> all;
  cv::findNonZero(mask, all);
  std::vector<cv::Point> expected;
  cv::convexHull(all, expected);
  EXPECT_EQ(cv::contourArea(convex_hull(mask)), cv::contourArea(expected));
  EXPECT_EQ(cv::boundingRect(convex_hull(mask)), cv::boundingRect(mask));
}

TEST(UncertaintyMap, EachRuleFindsTheDisc) {
  const cv::Mat map = with_disc(calm_map(), {100, 80}, 20, 1.5);
  cv::Mat truth = cv::Mat::zeros(map.size(), CV_8U);
  cv::circle(truth, {100, 80}, 20, 255, cv::FILLED);
  for (const ThresholdRule rule :
       {ThresholdRule::kFixed, ThresholdRule::kQuantile, ThresholdRule::kOtsu, ThresholdRule::kMedianMad}) {
    MapOptions options;
    options.rule = rule;
    options.quantile = 0.985;
    const MapSteps steps = find_regions(map, options);
    ASSERT_EQ(steps.status, MapStatus::kOk) << to_string(rule);
    ASSERT_FALSE(steps.regions.empty()) << to_string(rule);
    const Region& region = steps.regions.front();
    EXPECT_NEAR(region.centroid_px.x, 100, 1.5) << to_string(rule);
    EXPECT_NEAR(region.centroid_px.y, 80, 1.5) << to_string(rule);
    // median + k MAD of a calm map lies at the very foot of the blurred disc.
    EXPECT_GT(iou(steps.labels == region.label, truth), rule == ThresholdRule::kMedianMad ? 0.45 : 0.6)
        << to_string(rule);
    EXPECT_GT(region.contrast(), 2.5) << to_string(rule);
    EXPECT_FALSE(region.touches_border);
  }
}

TEST(UncertaintyMap, ARingEnclosesItsInside) {
  const cv::Mat map = with_ring(calm_map(), {160, 120}, 40, 5, 1.2);
  MapOptions options;
  const MapSteps filled = find_regions(map, options);
  ASSERT_EQ(filled.regions.size(), 1U);
  EXPECT_NEAR(filled.regions[0].area_px, M_PI * 42 * 42, 700);
  options.fill_holes = false;
  const MapSteps rim = find_regions(map, options);
  ASSERT_EQ(rim.regions.size(), 1U);
  EXPECT_LT(rim.regions[0].area_px, 0.5 * filled.regions[0].area_px);
}

TEST(UncertaintyMap, BackgroundSubtractionIgnoresASlope) {
  // Bright towards the right, but no edge there; the thing lies in the dark part.
  cv::Mat map = calm_map(0.2, 0.005);
  for (int x = 0; x < map.cols; ++x) {
    map.col(x) += 1.5 * x / map.cols;
  }
  with_disc(map, {60, 120}, 10, 1.0);
  MapOptions options;
  options.rule = ThresholdRule::kFixed;
  options.fixed = 0.6;
  const MapSteps without = find_regions(map, options);
  EXPECT_EQ(without.mask.at<std::uint8_t>(120, 60), 0);
  EXPECT_NE(without.mask.at<std::uint8_t>(120, 300), 0);
  options.background_px = 80;
  const MapSteps with = find_regions(map, options);
  EXPECT_NE(with.mask.at<std::uint8_t>(120, 60), 0);
  EXPECT_EQ(with.mask.at<std::uint8_t>(120, 260), 0);
}

TEST(UncertaintyMap, FlatAndUnusableMaps) {
  EXPECT_EQ(find_regions(cv::Mat::zeros(kHeight, kWidth, CV_32F)).status, MapStatus::kFlat);
  EXPECT_EQ(find_regions(cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(3.7))).status, MapStatus::kFlat);
  for (const auto& [name, map] : unusable_maps()) {
    EXPECT_EQ(find_regions(map).status, MapStatus::kInvalidInput) << name;
  }
}

TEST(UncertaintyMap, LeavesTheCallersMapAlone) {
  const cv::Mat map = with_disc(calm_map(), {100, 80}, 20, 1.5);
  const cv::Mat before = map.clone();
  MapOptions options;
  for (const double smooth : {0.0, 2.0}) {
    options.smooth_px = smooth;
    const MapSteps steps = find_regions(map, options);
    EXPECT_NE(steps.scalar.data, map.data) << smooth;
    EXPECT_EQ(cv::norm(map, before, cv::NORM_INF), 0.0) << smooth;
  }
}

TEST(UncertaintyMap, RefusesImpossibleOptions) {
  const cv::Mat map = calm_map();
  MapOptions options;
  options.low_quantile = options.high_quantile;
  EXPECT_THROW(find_regions(map, options), Error);
  options = {};
  options.smooth_px = std::nan("");
  EXPECT_THROW(find_regions(map, options), Error);
  options = {};
  options.min_area = 0.6;
  EXPECT_THROW(find_regions(map, options), Error);
}

TEST(FreeSpace, IsTheLargerSideOfABar) {
  cv::Mat unsafe = cv::Mat::zeros(kHeight, kWidth, CV_8U);
  unsafe(cv::Rect(100, 0, 40, kHeight)) = 255;
  const FreeSpace space = largest_free_space(unsafe, {0, 0, kWidth, kHeight});
  ASSERT_TRUE(space.found);
  EXPECT_NEAR(space.center_px.x, 229.5, 0.6);
  EXPECT_NEAR(space.center_px.y, 119.5, 0.6);
  EXPECT_NEAR(space.area_px, 180 * 240, 1);
  EXPECT_NEAR(space.clearance_px, 90, 2);
  EXPECT_FALSE(largest_free_space(cv::Mat(kHeight, kWidth, CV_8U, cv::Scalar(255)), {0, 0, 320, 240}).found);
  EXPECT_FALSE(largest_free_space(unsafe, {500, 0, 10, 10}).found);
}

TEST(FreeSpace, ItsCentreLiesInIt) {
  // A horseshoe's centroid does not.
  cv::Mat unsafe(kHeight, kWidth, CV_8U, cv::Scalar(255));
  cv::ellipse(unsafe, {160, 120}, {90, 90}, 0, 60, 300, 0, 30);
  const FreeSpace space = largest_free_space(unsafe, {0, 0, kWidth, kHeight});
  ASSERT_TRUE(space.found);
  EXPECT_NE(space.mask.at<std::uint8_t>(cvRound(space.center_px.y), cvRound(space.center_px.x)), 0);
  EXPECT_GT(space.clearance_px, 10);
}

// --- dodge -----------------------------------------------------------------------------------------------------------

TEST(Dodge, TracksADiscAndGoesTheOtherWay) {
  DodgePipeline pipeline;
  DodgeResult result;
  for (int i = 0; i < 3; ++i) {
    // To the right at 6 px a frame, growing.
    const cv::Mat map = with_disc(calm_map(), {120 + 6 * i, 120}, 12 + i, 1.6);
    result = pipeline.step(map, i * kFrame);
    EXPECT_EQ(result.status, i < 2 ? DodgeStatus::kDetected : DodgeStatus::kIncoming) << i;
    cv::Mat truth = cv::Mat::zeros(map.size(), CV_8U);
    cv::circle(truth, {120 + 6 * i, 120}, 12 + i, 255, cv::FILLED);
    EXPECT_GT(iou(result.mask, truth), 0.6) << i;
  }
  EXPECT_NEAR(result.velocity_px_s.x(), 180, 15);
  EXPECT_NEAR(result.velocity_px_s.y(), 0, 15);
  ASSERT_TRUE(result.contact_from_growth);
  EXPECT_NEAR(result.time_to_contact_s, 13.0 / 30.0, 0.15);
  EXPECT_GT(result.impact_px.x(), 160);
  ASSERT_TRUE(result.safe_direction);
  EXPECT_LT(result.safe_direction->x(), -0.9);
}

TEST(Dodge, ADirectHitIsLeftSideways) {
  DodgePipeline pipeline;
  DodgeResult result;
  for (int i = -8; i < 0; ++i) {
    pipeline.step(calm_map(), i * kFrame);
  }
  for (int i = 0; i < 7; ++i) {
    result = pipeline.step(with_disc(calm_map(), {200, 120}, 10 + 2 * i, 1.6), i * kFrame);
    EXPECT_EQ(result.status, i < 6 ? DodgeStatus::kDetected : DodgeStatus::kIncoming) << "confirm_s, frame " << i;
  }
  ASSERT_EQ(result.status, DodgeStatus::kIncoming);
  EXPECT_LT(result.safe_direction->x(), -0.9);  // it is seen on the right
}

TEST(Dodge, TurningCameraIsTakenOut) {
  DodgePipeline still, turning;
  DodgeResult seen, corrected;
  // A camera that yaws to the right sees a far thing that hangs still move to the left.
  const double omega = 0.6, focal = 160 / std::tan(0.6);
  for (int i = 0; i < 3; ++i) {
    const int x = cvRound(160 - focal * std::tan(omega * i * kFrame));
    const cv::Mat map = with_disc(calm_map(), {x, 120}, 14, 1.6);
    seen = still.step(map, i * kFrame);
    corrected = turning.step(map, i * kFrame, Eigen::Vector3d(0, omega, 0));
  }
  EXPECT_LT(seen.velocity_px_s.x(), -100);
  EXPECT_LT(std::abs(corrected.velocity_px_s.x()), 25);
}

TEST(Dodge, SaysThatThereIsNothing) {
  DodgePipeline pipeline;
  EXPECT_EQ(pipeline.step(cv::Mat::zeros(kHeight, kWidth, CV_32F), 0).status, DodgeStatus::kNoObstacle);
  EXPECT_EQ(pipeline.step(cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(2)), 1).status, DodgeStatus::kNoObstacle);
  EXPECT_EQ(pipeline.step(calm_map(), 2).status, DodgeStatus::kNoObstacle);
  // Stands out, but means next to nothing in absolute terms.
  EXPECT_EQ(pipeline.step(with_disc(calm_map(0.01, 0.001), {100, 100}, 15, 0.15), 3).status, DodgeStatus::kNoObstacle);
}

TEST(Dodge, UnusableMapsMissingAndUnorderedFrames) {
  DodgePipeline pipeline;
  const cv::Mat map = with_disc(calm_map(), {100, 100}, 15, 1.5);
  for (const auto& [name, bad] : unusable_maps()) {
    pipeline.reset();
    pipeline.step(map, 0.0);
    const DodgeResult result = pipeline.step(bad, kFrame);
    EXPECT_EQ(result.status, DodgeStatus::kInvalidInput) << name;
    EXPECT_FALSE(result.safe_direction) << name;
    EXPECT_EQ(pipeline.step(map, 2 * kFrame).track.size(), 1U) << name;
  }
  pipeline.reset();
  pipeline.step(map, 1.0);
  EXPECT_EQ(pipeline.step(map, 1.0).status, DodgeStatus::kOutOfOrder);
  EXPECT_EQ(pipeline.step(map, 0.5).status, DodgeStatus::kOutOfOrder);
  EXPECT_EQ(pipeline.step(map, std::nan("")).status, DodgeStatus::kOutOfOrder);
  EXPECT_EQ(pipeline.step(map, 1.0 + kFrame).track.size(), 2U);  // the order is kept
  EXPECT_EQ(pipeline.step(map, 3.0).track.size(), 1U);           // two seconds are missing: a new track
}

// --- navigate --------------------------------------------------------------------------------------------------------

TEST(NavigationWeight, MeetsTheLimitsOfTheTextAndThePrintedOneDoesNot) {
  const double floor = 0.3;
  EXPECT_NEAR(navigation_weight(WeightRule::kLimits, 0.5, 0.5, 0.5, floor), 0.0, 1e-12);
  EXPECT_GT(navigation_weight(WeightRule::kLimits, 8.0, 4.0, 0.3, floor), 0.99);
  EXPECT_NEAR(navigation_weight(WeightRule::kRescaled, 0.5, 0.5, 0.5, floor), 0.0, 1e-12);
  EXPECT_GT(navigation_weight(WeightRule::kRescaled, 3.0, 0.3, 0.3, floor), 0.99);
  EXPECT_NEAR(navigation_weight(WeightRule::kPrinted, 0.5, 0.5, 0.5, floor), 1.0 / (1.0 + std::exp(-1.0)), 1e-12);
  double last = -1.0;
  for (double y = 0.3; y < 5.0; y += 0.1) {
    const double w = navigation_weight(WeightRule::kLimits, y, 0.3, 0.3, floor);
    EXPECT_GT(w, last);
    EXPECT_LE(w, 1.0);
    last = w;
  }
  EXPECT_THROW(navigation_weight(WeightRule::kLimits, -1.0, 0.0, 0.0, floor), Error);
  EXPECT_THROW(navigation_weight(WeightRule::kLimits, std::nan(""), 0.0, 0.0, floor), Error);
}

TEST(Navigate, PassesATrunkOnItsWiderSide) {
  NavigatePipeline pipeline;
  const NavigateResult right = pipeline.step(trunk(130, 30, 2.0), 0.0);
  ASSERT_EQ(right.status, NavigateStatus::kOk);
  EXPECT_GT(right.free_px.x(), 160);
  EXPECT_GT(right.free_direction.y(), 0.0);
  EXPECT_GT(right.weight, 0.3);
  pipeline.reset();
  const NavigateResult left = pipeline.step(trunk(160, 30, 2.0), kFrame);
  EXPECT_LT(left.free_px.x(), 160);
  EXPECT_LT(left.free_direction.y(), 0.0);
  // Both rims are one obstacle: no way through the trunk.
  EXPECT_EQ(left.free.mask.at<std::uint8_t>(120, 175), 0);
  // The nearer, the more it counts.
  pipeline.reset();
  EXPECT_GT(left.weight, pipeline.step(trunk(160, 30, 0.9), 0.0).weight);
}

TEST(Navigate, NothingNearMeansTheGoal) {
  NavigatePipeline pipeline;
  const Eigen::Vector3d goal(1.0, 0.3, -0.1);
  for (const double level : {0.0, 0.2}) {
    pipeline.reset();
    const NavigateResult result = pipeline.step(cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(level)), 0.0, goal);
    EXPECT_EQ(result.status, NavigateStatus::kOk);
    EXPECT_EQ(result.weight, 0.0);
    EXPECT_LT((result.free_direction - goal.normalized()).norm(), 1e-12);
  }
}

TEST(Navigate, StopsWhereNothingIsFree) {
  NavigatePipeline pipeline;
  const NavigateResult wall = pipeline.step(cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(9.0)), 0.0);
  EXPECT_EQ(wall.status, NavigateStatus::kBlocked);
  EXPECT_EQ(wall.weight, 1.0);
  cv::Mat slit = calm_map(3.0);
  slit(cv::Rect(0, 0, 4, kHeight)) = 0.1;
  slit(cv::Rect(158, 0, 3, kHeight)) = 0.1;
  EXPECT_EQ(pipeline.step(slit, 1.0).status, NavigateStatus::kBlocked);
}

TEST(Navigate, AGoalOutsideOfTheImageIsLookedForAtItsEdge) {
  NavigatePipeline pipeline;
  const NavigateResult right = pipeline.step(calm_map(), 0.0, Eigen::Vector3d(0.2, 1.0, 0.0));
  EXPECT_EQ(right.goal_px.x(), kWidth - 1);
  EXPECT_EQ(right.window.x + right.window.width, kWidth);
  const NavigateResult behind = pipeline.step(calm_map(), 1.0, Eigen::Vector3d(-1.0, -0.2, 0.0));
  EXPECT_EQ(behind.goal_px.x(), 0.0);
  EXPECT_THROW(pipeline.step(calm_map(), 2.0, Eigen::Vector3d::Zero()), Error);
}

TEST(Navigate, DirectionsAreThoseOfTheSecondFrame) {
  NavigatePipeline turning, still;
  turning.step(trunk(130, 30, 2.0), 0.0);
  still.step(trunk(130, 30, 2.0), 0.0);
  const auto fixed = still.step(trunk(130, 30, 2.0), 0.1);
  const auto turned = turning.step(trunk(130, 30, 2.0), 0.1, Eigen::Vector3d::UnitX(), Eigen::Vector3d(0, 0.5, 0));
  // 0.05 rad of yaw to the right since the first frame: what it shows now lies that much further left.
  const double moved = std::atan2(turned.free_direction.y(), turned.free_direction.x()) -
                       std::atan2(fixed.free_direction.y(), fixed.free_direction.x());
  EXPECT_LT(moved, -0.02);
  EXPECT_NEAR(turned.goal_px.x() - fixed.goal_px.x(), 0.05 * 160 / std::tan(0.6), 0.5);
}

TEST(Navigate, UnusableMapsAndUnorderedFrames) {
  NavigatePipeline pipeline;
  double t = 0.0;
  for (const auto& [name, bad] : unusable_maps()) {
    EXPECT_EQ(pipeline.step(bad, t += 0.1).status, NavigateStatus::kInvalidInput) << name;
  }
  EXPECT_EQ(pipeline.step(calm_map(), t).status, NavigateStatus::kOutOfOrder);
  EXPECT_EQ(pipeline.step(calm_map(), 100.0).status, NavigateStatus::kOk);
}

// --- segment ---------------------------------------------------------------------------------------------------------

TEST(Segment, KeepsAttentionAndOutlineApart) {
  cv::Mat frame(kHeight, kWidth, CV_8UC3, cv::Scalar(90, 120, 60));
  cv::Mat truth = cv::Mat::zeros(kHeight, kWidth, CV_8U);
  for (const cv::Point& center : {cv::Point(150, 110), cv::Point(175, 130), cv::Point(140, 135)}) {
    cv::circle(frame, center, 24, cv::Scalar(200, 80, 90), cv::FILLED);
    cv::circle(truth, center, 24, 255, cv::FILLED);
  }
  cv::Mat noise(frame.size(), CV_8UC3);
  cv::RNG random(2);
  random.fill(noise, cv::RNG::UNIFORM, 0, 16);
  frame += noise;
  // The uncertainty marks the rims, broadly and a little off.
  cv::Mat edges;
  cv::morphologyEx(truth, edges, cv::MORPH_GRADIENT, cv::getStructuringElement(cv::MORPH_ELLIPSE, {13, 13}));
  cv::Mat map = calm_map();
  map.setTo(1.2, edges);
  for (const SegmentMethod method : {SegmentMethod::kWatershed, SegmentMethod::kGrabCut}) {
    SegmentOptions options;
    options.method = method;
    const SegmentResult result = segment_pile(view_of(frame), map, options);
    ASSERT_EQ(result.status, SegmentStatus::kOk) << to_string(method);
    EXPECT_GT(iou(result.attention, truth), 0.6) << to_string(method);
    EXPECT_GT(iou(result.segmentation, truth), 0.9) << to_string(method);
    EXPECT_GT(iou(result.segmentation, truth), iou(result.attention, truth)) << to_string(method);
  }
}

TEST(Segment, WithoutAttentionThereIsNoOutline) {
  const cv::Mat frame = textured(1);
  EXPECT_EQ(segment_pile(view_of(frame), cv::Mat::zeros(kHeight, kWidth, CV_32F)).status, SegmentStatus::kNoObject);
  const SegmentResult calm = segment_pile(view_of(frame), calm_map());
  EXPECT_EQ(calm.status, SegmentStatus::kNoObject);
  EXPECT_TRUE(calm.segmentation.empty());
  for (const auto& [name, bad] : unusable_maps()) {
    EXPECT_EQ(segment_pile(view_of(frame), bad).status, SegmentStatus::kInvalidInput) << name;
  }
  EXPECT_EQ(segment_pile({}, calm_map()).status, SegmentStatus::kInvalidInput);
  EXPECT_EQ(segment_pile(view_of(frame(cv::Rect(0, 0, 100, 100))), calm_map()).status, SegmentStatus::kInvalidInput);
}

}  // namespace
}  // namespace ajna::tasks
