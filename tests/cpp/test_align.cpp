// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <Eigen/Geometry>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/tasks/align.hpp"
#include "task_maps.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFov = 1.2;

/// Mean absolute difference where `valid` says so, grey levels.
double difference(const cv::Mat& a, const cv::Mat& b, const cv::Mat& valid) {
  cv::Mat distance;
  cv::absdiff(a, b, distance);
  const cv::Scalar mean = cv::mean(distance, valid);
  return (mean[0] + mean[1] + mean[2]) / 3.0;
}

TEST(Align, TakesTheMotionOfAPlaneOut) {
  const cv::Mat reference = textured(3);
  const cv::Matx33d truth(1.03, 0.02, -6.0, -0.01, 0.98, 4.0, 2e-5, -3e-5, 1.0);  // reference to frame
  cv::Mat frame;
  cv::warpPerspective(reference, frame, cv::Mat(truth), reference.size());
  // A square that moves on its own does not count.
  cv::Mat square = frame(cv::Rect(140, 90, 50, 50));
  textured(9)(cv::Rect(0, 0, 50, 50)).copyTo(square);
  const Alignment found = align_to(view_of(reference), view_of(frame));
  ASSERT_TRUE(found.found);
  EXPECT_GT(found.inliers, 0.8 * found.tracked);
  cv::Mat wall = found.valid.clone();
  wall(cv::Rect(120, 70, 90, 90)).setTo(0);
  EXPECT_LT(difference(found.image, reference, wall), 3.0);
  EXPECT_GT(difference(frame, reference, wall), 15.0);
  EXPECT_EQ(found.valid.at<std::uint8_t>(1, 1), 0);  // there the frame has nothing
  EXPECT_EQ(found.valid.at<std::uint8_t>(120, 60), 255);
}

TEST(Align, WithoutCommonTextureTheFrameStays) {
  const cv::Mat plain(kHeight, kWidth, CV_8UC3, cv::Scalar(90, 90, 90));
  const cv::Mat other = textured(4);
  for (const cv::Mat& reference : {plain, textured(5)}) {
    const Alignment found = align_to(view_of(reference), view_of(other));
    EXPECT_FALSE(found.found);
    EXPECT_EQ(cv::norm(found.image, other, cv::NORM_INF), 0.0);
    EXPECT_EQ(cv::countNonZero(found.valid), kWidth * kHeight);
  }
}

TEST(Align, RotationIsTakenOut) {
  const cv::Mat reference = textured(3);
  const Eigen::Matrix3d turn = Eigen::AngleAxisd(0.12, Eigen::Vector3d(0.3, -0.5, 0.8).normalized()).matrix();
  // Where a direction of the reference is seen by the turned camera.
  const auto camera = geometry::Camera::from_horizontal_fov(kWidth, kHeight, kFov);
  const Eigen::Vector3d ray(0.1, -0.05, 1.0);
  const Eigen::Vector2d here = camera.project(ray).value();
  const Eigen::Vector2d there = camera.project(turn.transpose() * ray).value();
  const Alignment back = derotate_frame(view_of(reference), turn, kFov);
  ASSERT_TRUE(back.found);
  const cv::Vec3d mapped = back.reference_from_frame * cv::Vec3d(there.x(), there.y(), 1.0);
  EXPECT_NEAR(mapped[0] / mapped[2], here.x(), 1e-6);
  EXPECT_NEAR(mapped[1] / mapped[2], here.y(), 1e-6);
  const Alignment forth = derotate_frame(view_of(back.image), turn.transpose(), kFov);
  EXPECT_LT(difference(forth.image, reference, back.valid & forth.valid), 12.0);
  EXPECT_THROW(derotate_frame(view_of(reference), 2.0 * turn, kFov), Error);
  EXPECT_THROW(derotate_frame({}, turn, kFov), Error);
}

TEST(Align, ValidIsWhereAWhiteFrameWouldBe) {
  const cv::Mat white(120, 160, CV_8UC3, cv::Scalar::all(255));
  AlignOptions options;
  options.margin_px = 0;
  for (const double angle : {0.0, 0.05, 0.3, 1.2, 2.5}) {
    const Eigen::Matrix3d turn =
        (Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitY()) * Eigen::AngleAxisd(0.4 * angle, Eigen::Vector3d::UnitZ()))
            .toRotationMatrix();
    const Alignment turned = derotate_frame(view_of(white), turn, kFov, options);
    cv::Mat expected;
    cv::warpPerspective(cv::Mat(white.size(), CV_8U, cv::Scalar(255)), expected, cv::Mat(turned.reference_from_frame),
                        white.size(), cv::INTER_NEAREST);
    cv::Mat differ;
    cv::bitwise_xor(expected, turned.valid, differ);
    EXPECT_LE(cv::countNonZero(differ), 2 * (160 + 120)) << angle << ": but for the rim they agree";
  }
}

TEST(Align, WithinGivesTheRestsMedian) {
  cv::Mat map = calm_map(0.4, 0.01);
  cv::Mat valid(map.size(), CV_8U, cv::Scalar(255));
  map.colRange(0, 30).setTo(9.0);
  valid.colRange(0, 30).setTo(0);
  const cv::Mat quiet = within(map, valid);
  EXPECT_NEAR(quiet.at<float>(100, 10), 0.4, 0.01);
  EXPECT_EQ(quiet.at<float>(100, 200), map.at<float>(100, 200));
  EXPECT_EQ(map.at<float>(100, 10), 9.0F);  // the map itself is left alone
  EXPECT_EQ(cv::norm(within(map, cv::Mat::zeros(map.size(), CV_8U)), map, cv::NORM_INF), 0.0);
}

TEST(Align, RefusesWhatIsNoPair) {
  const cv::Mat frame = textured(3);
  const cv::Mat half = frame(cv::Rect(0, 0, 160, 240)).clone();
  EXPECT_THROW(align_to(view_of(frame), view_of(half)), Error);
  EXPECT_THROW(align_to({}, view_of(frame)), Error);
  AlignOptions options;
  options.min_inliers = 3;
  EXPECT_THROW(align_to(view_of(frame), view_of(frame), options), Error);
}

}  // namespace
}  // namespace ajna::tasks
