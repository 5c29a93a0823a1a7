// SPDX-License-Identifier: MIT
// What a hovering camera has always seen is no obstacle; what is new is one long before it stands out of the map.
#include <gtest/gtest.h>

#include "ajna/base/error.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/map_background.hpp"
#include "task_maps.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFrame = 1.0 / 30.0;

/// A map in which one place is always five times as uncertain as the rest, with noise of a hundredth.
cv::Mat uneven_map(unsigned seed) {
  cv::Mat map(kHeight, kWidth, CV_32F);
  cv::theRNG().state = seed + 1;
  cv::randn(map, 0.15, 0.004);
  map(cv::Rect(30, 40, 50, 30)) += 0.6F;
  cv::max(map, 0.0, map);
  return map;
}

/// As step() says of map after map, from frame `from` on.
MapBackground learnt(int frames, BackgroundOptions options = {}) {
  MapBackground background(options);
  for (int i = 0; i < frames; ++i) {
    background.step(uneven_map(static_cast<unsigned>(i)), i * kFrame);
  }
  return background;
}

TEST(MapBackground, NeedsTimeThenSeesNothingWhereNothingHappens) {
  MapBackground background;
  for (int i = 0; i < 60; ++i) {
    const auto rise = background.step(uneven_map(static_cast<unsigned>(i)), i * kFrame);
    EXPECT_EQ(rise.has_value(), i * kFrame >= BackgroundOptions{}.learn_s) << i;
    if (rise) {
      double highest = 0.0;
      cv::minMaxLoc(rise->map, nullptr, &highest);
      EXPECT_LT(highest, rise->threshold) << i;  // the uncertain place is no rise
      EXPECT_GE(rise->threshold, BackgroundOptions{}.min_rise);
    }
  }
}

TEST(MapBackground, SeesWhatIsNewAndTakesItInAtLast) {
  MapBackground background = learnt(30);
  const cv::Point at(200, 120);
  const auto seen = [&](int i) {
    const auto rise = background.step(with_disc(uneven_map(static_cast<unsigned>(i)), at, 8, 0.25F), i * kFrame);
    return rise.has_value() && static_cast<double>(rise->map.at<float>(at)) > rise->threshold;
  };
  EXPECT_TRUE(seen(30));  // 0.25 on 0.15 in a map that has 0.75 elsewhere
  EXPECT_TRUE(seen(35));
  bool last = true;
  for (int i = 36; i < 36 + 150; ++i) {
    last = seen(i);
  }
  EXPECT_FALSE(last);
}

TEST(MapBackground, ALightThatBlinksAgainAndAgainIsLearnt) {
  MapBackground background = learnt(10);
  const cv::Point at(200, 120);
  int early = 0, late = 0;
  for (int i = 10; i < 310; ++i) {
    const bool lit = i % 15 < 5;
    const cv::Mat map = uneven_map(static_cast<unsigned>(i));
    const auto rise = background.step(lit ? with_disc(map, at, 8, 0.4) : map, i * kFrame);
    const bool seen = rise && static_cast<double>(rise->map.at<float>(at)) > rise->threshold;
    early += static_cast<int>(seen && i < 40);
    late += static_cast<int>(seen && i >= 160);
  }
  EXPECT_GT(early, 0);
  EXPECT_EQ(late, 0);
}

TEST(MapBackground, LearnsAnewWhenTheCameraMoves) {
  MapBackground background = learnt(30);
  EXPECT_FALSE(background.step(uneven_map(30), 30 * kFrame, 0.2).has_value());  // it has turned
  EXPECT_FALSE(background.step(uneven_map(31), 31 * kFrame).has_value());
  background = learnt(30);
  EXPECT_FALSE(background.step(uneven_map(30) + 0.5, 30 * kFrame).has_value());  // all of the picture at once
  background = learnt(30);
  EXPECT_FALSE(background.step(cv::Mat(kHeight / 2, kWidth, CV_32F, cv::Scalar(0.1)), 30 * kFrame).has_value());
}

TEST(MapBackground, ANoisyPictureRaisesTheThreshold) {
  MapBackground calm, restless;
  double low = 0.0, high = 0.0;
  for (int i = 0; i < 40; ++i) {
    cv::Mat noise(kHeight, kWidth, CV_32F);
    cv::theRNG().state = static_cast<unsigned>(i) + 7;
    cv::randn(noise, 0.3, 0.002);
    const auto a = calm.step(noise, i * kFrame);
    const auto b = restless.step(cv::max(noise * 30.0 - 8.0, 0.0), i * kFrame);
    low = a ? a->threshold : low;
    high = b ? b->threshold : high;
  }
  EXPECT_GT(high, 5.0 * low);
}

TEST(MapBackground, NamesOptionsOutOfRange) {
  BackgroundOptions options;
  options.min_rise = 0.0;
  EXPECT_THROW(validate(options), Error);
  options = {};
  options.absorb_s = 0.1;  // below learn_s
  EXPECT_THROW(validate(options), Error);
  options = {};
  options.noise_factor = std::nan("");
  EXPECT_THROW(MapBackground{options}, Error);
}

/// Frames after which a faint disc that grows on the spot, as what hits the camera does, is confirmed.
int frames_until_incoming(const DodgeOptions& options) {
  DodgePipeline pipeline(options);
  for (int i = 0; i < 30; ++i) {
    const DodgeResult result = pipeline.step(uneven_map(static_cast<unsigned>(i)), i * kFrame);
    EXPECT_EQ(result.mask.empty(), options.background.use && i * kFrame >= options.background.learn_s) << i;
  }
  for (int i = 30; i < 60; ++i) {
    const auto map = with_disc(uneven_map(static_cast<unsigned>(i)), {200, 120}, 5 + (i - 30) / 3, 0.3F);
    const DodgeResult result = pipeline.step(map, i * kFrame);
    if (result.status == DodgeStatus::kIncoming && !result.mask.empty() &&
        result.mask.at<std::uint8_t>(120, 200) != 0) {
      return i - 30;
    }
  }
  return -1;
}

TEST(DodgeBackground, AFaintThingIsFoundBesideAnUncertainPlace) {
  DodgeOptions options;
  options.confirm_s = 0.0;
  EXPECT_EQ(frames_until_incoming(options), 2);  // three frames
  options.confirm_s = 5.5 * kFrame;
  EXPECT_EQ(frames_until_incoming(options), 6);  // it grows on the spot, and might be a light that has gone on
  options.background.use = false;
  EXPECT_EQ(frames_until_incoming(options), -1);  // the uncertain place is taken for the obstacle
}

}  // namespace
}  // namespace ajna::tasks
