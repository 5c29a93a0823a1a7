// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/tasks/closer_look.hpp"

namespace ajna::tasks {
namespace {

const cv::Size kFrame(320, 240);

cv::Mat disc(const cv::Point& middle, int radius) {
  cv::Mat mask(kFrame, CV_8U, cv::Scalar(0));
  cv::circle(mask, middle, radius, 255, cv::FILLED);
  return mask;
}

double overlap(const cv::Mat& a, const cv::Mat& b) {
  return static_cast<double>(cv::countNonZero(a & b)) / cv::countNonZero(a | b);
}

/// The map of an enlarged pair in which the pixels of `thing` are uncertain, blurred by as much as a network blurs.
cv::Mat map_of(const cv::Mat& thing, const CloserLook& look) {
  cv::Mat seen;
  cv::warpAffine(thing, seen, look.closer_from_frame, look.size);
  cv::Mat map;
  seen.convertTo(map, CV_32F, 1.0 / 255.0, 0.1);
  cv::GaussianBlur(map, map, {}, 5.0);
  return map;
}

TEST(CloserLook, ShowsTheMiddleOfTheMaskAsLargeAsFits) {
  const CloserLook small = closer_look_at(disc({200, 60}, 4));
  EXPECT_EQ(small.size, cv::Size(240, 176));
  const cv::Vec2d middle = small.closer_from_frame * cv::Vec3d(200.0, 60.0, 1.0);
  EXPECT_NEAR(middle[0], 119.5, 1e-9);
  EXPECT_NEAR(middle[1], 87.5, 1e-9);
  EXPECT_DOUBLE_EQ(small.closer_from_frame(0, 0), 8.0);
  const CloserLook large = closer_look_at(disc({160, 120}, 30));
  EXPECT_LT(large.closer_from_frame(0, 0) * 61, 176.0);
  EXPECT_GT(large.closer_from_frame(0, 0), 1.5);
  const cv::Mat all(kFrame, CV_8U, cv::Scalar(255));
  EXPECT_DOUBLE_EQ(closer_look_at(all).closer_from_frame(0, 0), 1.0) << "never smaller than it is";
}

TEST(CloserLook, EnlargesPixelsToWhereItSays) {
  Image frame(320, 240);
  for (int y = 0; y < 240; ++y) {
    for (int x = 0; x < 320; ++x) {
      auto* pixel = frame.data() + 3 * (y * 320 + x);
      pixel[0] = static_cast<std::uint8_t>(x / 2);
      pixel[1] = static_cast<std::uint8_t>(y);
      pixel[2] = 7;
    }
  }
  const CloserLook look = closer_look_at(disc({100, 80}, 4));
  const Image closer = enlarge(frame.view(), look);
  ASSERT_EQ(closer.width(), 240);
  ASSERT_EQ(closer.height(), 176);
  for (const cv::Point& at : {cv::Point(10, 10), cv::Point(119, 87), cv::Point(230, 150)}) {
    const auto* pixel = closer.data() + 3 * (at.y * 240 + at.x);
    const double x = 100.0 + (at.x - 119.5) / 8.0;
    const double y = 80.0 + (at.y - 87.5) / 8.0;
    EXPECT_NEAR(pixel[0], x / 2.0, 1.0);
    EXPECT_NEAR(pixel[1], y, 1.0);
    EXPECT_EQ(pixel[2], 7);
  }
  EXPECT_EQ(enlarge(frame.view(), closer_look_at(disc({319, 239}, 4))).data()[3 * (240 * 176 - 1)], 159)
      << "beyond the edge its last pixel";
  EXPECT_THROW(enlarge({}, look), Error);
}

TEST(CloserLook, OutlinesAThingOfSixPixelsInAMaskSeveralTimesAsLarge) {
  const cv::Mat thing = disc({151, 97}, 3);
  const cv::Mat mask = disc({149, 99}, 8);
  ASSERT_LT(overlap(thing, mask), 0.2);
  const CloserLook look = closer_look_at(mask);
  const cv::Mat found = outline(map_of(thing, look), mask, look);
  ASSERT_EQ(found.size(), kFrame);
  EXPECT_GT(overlap(thing, found), 0.8);
  // What stands out elsewhere is not what was found, and of two things within the mask the stronger one counts.
  EXPECT_GT(overlap(thing, outline(map_of(thing | disc({162, 99}, 2), look), mask, look)), 0.8);
  const cv::Mat weaker = 0.5 * map_of(disc({143, 103}, 2), look) + map_of(thing, look);
  EXPECT_GT(overlap(thing, outline(weaker, mask, look)), 0.6);
}

TEST(CloserLook, OutlinesWhatLeavesTheFrame) {
  const cv::Mat thing = disc({0, 120}, 5);
  const CloserLook look = closer_look_at(disc({2, 120}, 9));
  EXPECT_GT(overlap(thing, outline(map_of(thing, look), disc({2, 120}, 9), look)), 0.7);
}

TEST(CloserLook, SaysNothingWhereTheMapTellsNothing) {
  const cv::Mat mask = disc({100, 100}, 6);
  const CloserLook look = closer_look_at(mask);
  EXPECT_TRUE(outline(cv::Mat(look.size, CV_32F, cv::Scalar(0.3)), mask, look).empty()) << "flat";
  EXPECT_TRUE(outline(cv::Mat(look.size, CV_32F, cv::Scalar(0.0)), mask, look).empty()) << "zero";
  EXPECT_TRUE(outline({}, mask, look).empty());
  EXPECT_TRUE(outline(cv::Mat(kFrame, CV_32F, cv::Scalar(0.3)), mask, look).empty()) << "another size";
  cv::Mat broken = map_of(mask, look);
  broken.at<float>(80, 80) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_TRUE(outline(broken, mask, look).empty());
  cv::Mat speck(look.size, CV_32F, cv::Scalar(0.3));
  speck.at<float>(85, 117) = 2.0F;
  EXPECT_TRUE(outline(speck, mask, look).empty()) << "smaller than a pixel of the frame";
}

TEST(CloserLook, BadInputIsNamed) {
  EXPECT_THROW(closer_look_at({}), Error);
  EXPECT_THROW(closer_look_at(cv::Mat(kFrame, CV_8U, cv::Scalar(0))), Error) << "nothing found, nowhere to look";
  EXPECT_THROW(closer_look_at(cv::Mat(kFrame, CV_32F, cv::Scalar(1))), Error);
  for (const auto& [enlarge, width, height, margin] : {std::tuple{0.5, 240, 176, 2},
                                                       {std::nan(""), 240, 176, 2},
                                                       {8.0, 8, 176, 2},
                                                       {8.0, 240, 5000, 2},
                                                       {8.0, 240, 176, -1}}) {
    CloserLookOptions options;
    options.enlarge = enlarge;
    options.width = width;
    options.height = height;
    options.margin_px = margin;
    EXPECT_THROW(validate(options), Error);
  }
}

}  // namespace
}  // namespace ajna::tasks
