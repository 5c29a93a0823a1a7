// SPDX-License-Identifier: MIT
// Gaps in maps, their contours carried along by real pixels, and what the pipeline says when it cannot.
#include <gtest/gtest.h>

#include "ajna/base/error.hpp"
#include "ajna/tasks/gap.hpp"
#include "task_maps.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFrame = 1.0 / 30.0;
const cv::Point kCenter(170, 110);
constexpr int kRadius = 45;

/// A wall with a round hole before a background: the camera is displaced by `shift_px` (of the wall) and has come
/// nearer by `zoom`; the background moves and grows less.
cv::Mat seen(const cv::Point2d& shift_px, double zoom) {
  static const cv::Mat wall = textured(1);
  static const cv::Mat background = textured(2);
  const auto warped = [](const cv::Mat& image, const cv::Point2d& shift, double scale, int flags) {
    const double cx = 0.5 * kWidth, cy = 0.5 * kHeight;
    const cv::Mat warp =
        (cv::Mat_<double>(2, 3) << scale, 0, cx - scale * cx + shift.x, 0, scale, cy - scale * cy + shift.y);
    cv::Mat result;
    cv::warpAffine(image, result, warp, image.size(), flags, cv::BORDER_REFLECT);
    return result;
  };
  cv::Mat hole = cv::Mat::zeros(kHeight, kWidth, CV_8U);
  cv::circle(hole, kCenter, kRadius, 255, cv::FILLED, cv::LINE_AA);
  cv::Mat frame = warped(wall, shift_px, zoom, cv::INTER_LINEAR);
  warped(background, 0.4 * shift_px, 1.0 + 0.4 * (zoom - 1.0), cv::INTER_LINEAR)
      .copyTo(frame, warped(hole, shift_px, zoom, cv::INTER_NEAREST) > 127);
  return frame;
}

cv::Mat gap_map() { return with_disc(calm_map(), kCenter, kRadius, 0.9); }

cv::Mat filled(const std::vector<cv::Point2f>& contour) {
  cv::Mat mask = cv::Mat::zeros(kHeight, kWidth, CV_8U);
  std::vector<std::vector<cv::Point>> polygon(1);
  for (const auto& point : contour) {
    polygon[0].emplace_back(cvRound(point.x), cvRound(point.y));
  }
  cv::fillPoly(mask, polygon, 255);
  return mask;
}

cv::Mat disc(const cv::Point2d& center, double radius) {
  cv::Mat mask = cv::Mat::zeros(kHeight, kWidth, CV_8U);
  cv::circle(mask, center, cvRound(radius), 255, cv::FILLED);
  return mask;
}

/// Explores until the gap is tracked; the time of the last frame.
double explore(GapPipeline& pipeline, GapResult& result) {
  result = pipeline.step(view_of(seen({}, 1.0)), {}, 0.0);
  EXPECT_EQ(result.status, GapStatus::kExploring);
  double t = 0.0;
  for (int i = 1; i <= pipeline.options().min_pairs; ++i) {
    EXPECT_TRUE(pipeline.wants_map());
    t = i * kFrame;
    result = pipeline.step(view_of(seen({3.0 * i, -3.0 * i}, 1.0)), gap_map(), t);
  }
  return t;
}

TEST(DetectGap, DiscRingAndIrregularShape) {
  for (const bool ring : {false, true}) {
    cv::Mat map = calm_map();
    ring ? cv::circle(map, kCenter, kRadius, 0.9, 8) : cv::circle(map, kCenter, kRadius, 0.9, cv::FILLED);
    const GapDetection gap = detect_gap(map);
    ASSERT_TRUE(gap.found) << ring;
    EXPECT_GT(iou(gap.mask, disc(kCenter, kRadius)), 0.75) << ring;
    EXPECT_NEAR(gap.safe_px.x(), kCenter.x, 2) << ring;
    EXPECT_NEAR(gap.safe_px.y(), kCenter.y, 2) << ring;
  }
  cv::Mat map = calm_map();
  cv::circle(map, {120, 120}, 30, 0.9, cv::FILLED);
  cv::circle(map, {165, 120}, 30, 0.9, cv::FILLED);  // an eight on its side
  const GapDetection eight = detect_gap(map);
  ASSERT_TRUE(eight.found);
  EXPECT_NEAR(eight.safe_px.x(), 142, 4);
}

TEST(DetectGap, ACertainRegionInAnUncertainWall) {
  const cv::Mat map = with_disc(calm_map(0.9), kCenter, kRadius, 0.4);
  EXPECT_FALSE(detect_gap(map).found);
  GapDetectionOptions options;
  options.certain = true;
  const GapDetection gap = detect_gap(map, options);
  ASSERT_TRUE(gap.found);
  EXPECT_TRUE(gap.certain);
  EXPECT_GT(iou(gap.mask, disc(kCenter, kRadius)), 0.75);
}

TEST(DetectGap, AGapThatTheClosingJoinsWithTheBorder) {
  cv::Mat map = with_disc(calm_map(), kCenter, kRadius, 0.9);
  const int beside = cvRound(kCenter.x - kRadius) - 28;
  map(cv::Rect(0, 0, beside, kHeight)) = 0.9;
  GapDetectionOptions options;
  options.retries = 0;
  EXPECT_FALSE(detect_gap(map, options).found);
  const GapDetection gap = detect_gap(map);
  ASSERT_TRUE(gap.found);
  EXPECT_GT(iou(gap.mask, disc(kCenter, kRadius)), 0.75);
  options.retries = 9;
  EXPECT_THROW(detect_gap(map, options), Error);
}

TEST(DetectGap, WhatIsNoGap) {
  EXPECT_FALSE(detect_gap(calm_map()).found);
  EXPECT_FALSE(detect_gap(cv::Mat::zeros(kHeight, kWidth, CV_32F)).found);
  EXPECT_FALSE(detect_gap(with_disc(calm_map(), {0, 120}, 60, 0.9)).found);  // open to the border
  cv::Mat line = calm_map();
  cv::line(line, {40, 40}, {280, 200}, 0.9, 6);
  EXPECT_FALSE(detect_gap(line).found);
  EXPECT_FALSE(detect_gap(with_disc(calm_map(), kCenter, kRadius, 0.32)).found);  // next to no contrast
  for (const auto& [name, bad] : unusable_maps()) {
    EXPECT_FALSE(detect_gap(bad).found) << name;
  }
}

TEST(Gap, DetectsAndFollowsTheContourOnTheWayIn) {
  GapPipeline pipeline;
  GapResult result;
  double t = explore(pipeline, result);
  ASSERT_EQ(result.status, GapStatus::kTracking);
  EXPECT_FALSE(pipeline.wants_map());
  // The contour was found in the reference frame, and is given in this one.
  EXPECT_GT(iou(filled(result.contour), disc(cv::Point2d(kCenter) + cv::Point2d(9, -9), kRadius)), 0.8);

  cv::Point2d shift(9, -9);
  double zoom = 1.0;
  for (int i = 0; i < 30; ++i) {
    zoom *= 1.02;
    t += kFrame;
    result = pipeline.step(view_of(seen(shift, zoom)), {}, t);
    ASSERT_EQ(result.status, GapStatus::kTracking) << i;
  }
  const cv::Point2d middle(0.5 * kWidth, 0.5 * kHeight);
  const cv::Point2d center = middle + zoom * (cv::Point2d(kCenter) - middle) + shift;
  EXPECT_GT(iou(filled(result.contour), disc(center, zoom * kRadius)), 0.8);
  EXPECT_NEAR(result.safe_px.x(), center.x, 5);
  EXPECT_NEAR(result.safe_px.y(), center.y, 5);
  EXPECT_NEAR(result.safe_offset.x(), (center.x - 159.5) * std::tan(0.6) / 160, 0.03);
  ASSERT_TRUE(result.focus_px);
  EXPECT_NEAR(result.focus_px->x(), middle.x + shift.x, 15);
  EXPECT_GE(result.features.foreground.size(), 8U);
}

TEST(Gap, IsThroughWhereTheContourSurroundsTheImage) {
  GapPipeline pipeline;
  GapResult result;
  double t = explore(pipeline, result);
  double zoom = 1.0;
  for (int i = 0; i < 90 && result.status == GapStatus::kTracking; ++i) {
    zoom *= 1.03;
    t += kFrame;
    result = pipeline.step(view_of(seen({9, -9}, zoom)), {}, t);
  }
  EXPECT_EQ(result.status, GapStatus::kThrough) << zoom;
  EXPECT_EQ(pipeline.step(view_of(textured(9)), {}, t + 1.0).status, GapStatus::kThrough);
}

TEST(Gap, SaysThatItIsLost) {
  GapPipeline pipeline;
  GapResult result;
  const double t = explore(pipeline, result);
  ASSERT_EQ(result.status, GapStatus::kTracking);
  // A black frame: nothing to track, and nothing is guessed.
  const cv::Mat black = cv::Mat::zeros(kHeight, kWidth, CV_8UC3);
  result = pipeline.step(view_of(black), {}, t + kFrame);
  EXPECT_EQ(result.status, GapStatus::kLost);
  EXPECT_TRUE(result.contour.empty());
  EXPECT_EQ(pipeline.step(view_of(seen({9, -9}, 1.0)), {}, t + 2 * kFrame).status, GapStatus::kLost);
  pipeline.reset();
  EXPECT_EQ(explore(pipeline, result), t);
  // Missing frames lose it as well.
  EXPECT_EQ(pipeline.step(view_of(seen({9, -9}, 1.0)), {}, t + 5.0).status, GapStatus::kLost);
}

TEST(Gap, GivesUpAndBeginsAnewWithoutAGap) {
  GapOptions options;
  options.max_pairs = 4;
  GapPipeline pipeline(options);
  const cv::Mat frame = textured(1);
  pipeline.step(view_of(frame), {}, 0.0);
  for (int i = 1; i <= 4; ++i) {
    const GapResult result = pipeline.step(view_of(frame), calm_map(), i * kFrame);
    EXPECT_EQ(result.status, i < 4 ? GapStatus::kExploring : GapStatus::kNoGap);
    EXPECT_EQ(result.pairs, i);
  }
  EXPECT_EQ(pipeline.step(view_of(frame), calm_map(), 5 * kFrame).pairs, 1);
}

TEST(Gap, UnusableInputAndUnorderedFrames) {
  GapPipeline pipeline;
  const cv::Mat frame = seen({}, 1.0);
  EXPECT_EQ(pipeline.step({}, {}, 0.0).status, GapStatus::kInvalidInput);
  const cv::Mat pixel = frame(cv::Rect(0, 0, 1, 1));
  EXPECT_EQ(pipeline.step(view_of(pixel), {}, 0.0).status, GapStatus::kInvalidInput);
  EXPECT_EQ(pipeline.step(view_of(frame), {}, 1.0).status, GapStatus::kExploring);
  for (const auto& [name, bad] : unusable_maps()) {
    const GapResult result = pipeline.step(view_of(frame), bad, 2.0);
    EXPECT_EQ(result.status, GapStatus::kInvalidInput) << name;
  }
  EXPECT_EQ(pipeline.step(view_of(frame(cv::Rect(0, 0, 160, 120))), gap_map(), 2.0).status, GapStatus::kInvalidInput);
  EXPECT_EQ(pipeline.step(view_of(frame), gap_map(), 0.5).status, GapStatus::kOutOfOrder);
  EXPECT_EQ(pipeline.step(view_of(frame), gap_map(), 2.0).pairs, 1);
}

TEST(Gap, RefusesImpossibleOptions) {
  GapOptions options;
  options.max_pairs = 1;
  EXPECT_THROW(GapPipeline{options}, Error);
  options = {};
  options.tracker.min_features = 2;
  EXPECT_THROW(GapPipeline{options}, Error);
  EXPECT_THROW(GapPipeline(GapOptions{}, 4.0), Error);
}

}  // namespace
}  // namespace ajna::tasks
