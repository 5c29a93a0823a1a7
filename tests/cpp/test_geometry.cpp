// SPDX-License-Identifier: MIT
// Camera, poses, Eq. 14 and the robust fits against closed forms.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <limits>
#include <random>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/geometry/focus_of_expansion.hpp"
#include "ajna/geometry/motion_field.hpp"
#include "ajna/geometry/pose.hpp"

namespace ajna::geometry {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

Camera wide() { return Camera::from_horizontal_fov(320, 240, 1.2); }

TEST(Camera, FieldOfViewAndPrincipalPoint) {
  const Camera camera = wide();
  EXPECT_NEAR(std::atan2(160.0, camera.fx), 0.6, 1e-12);
  const auto center = camera.project(Vector3d(0, 0, 3));
  ASSERT_TRUE(center);
  EXPECT_NEAR(center->x(), 159.5, 1e-12);
  EXPECT_NEAR(center->y(), 119.5, 1e-12);
  EXPECT_FALSE(camera.project(Vector3d(0, 0, -1)));
  EXPECT_FALSE(camera.project(Vector3d(1, 0, 0)));
  const Vector2d pixel(12.25, 200.5);
  EXPECT_LT((*camera.project(2.5 * camera.ray(pixel)) - pixel).norm(), 1e-9);
  EXPECT_NEAR(camera.ray(pixel).norm(), 1.0, 1e-12);
}

TEST(Camera, ResizedSeesTheSameRays) {
  const Camera camera = wide();
  const Camera half = camera.resized(160, 120);
  // The corner of the image, not the centre of its first pixel, keeps its ray.
  EXPECT_LT((camera.ray({-0.5, -0.5}) - half.ray({-0.5, -0.5})).norm(), 1e-12);
  EXPECT_LT((camera.ray({319.5, 239.5}) - half.ray({159.5, 119.5})).norm(), 1e-12);
}

TEST(Camera, RefusesWhatIsNoCamera) {
  EXPECT_THROW(Camera::from_horizontal_fov(0, 240, 1.0), Error);
  EXPECT_THROW(Camera::from_horizontal_fov(320, 240, 3.2), Error);
  EXPECT_THROW(Camera::from_horizontal_fov(320, 240, std::nan("")), Error);
  Camera broken = wide();
  broken.fx = -1.0;
  EXPECT_THROW(validate(broken), Error);
}

TEST(Pose, ComposesAndInverts) {
  const Pose a{Eigen::Quaterniond(Eigen::AngleAxisd(0.7, Vector3d(1, 2, 3).normalized())), {1, -2, 0.5}};
  const Pose b{Eigen::Quaterniond(Eigen::AngleAxisd(-1.1, Vector3d::UnitY())), {0, 4, 1}};
  const Vector3d point(0.3, -0.2, 2.0);
  EXPECT_LT(((a * b).transform(point) - a.transform(b.transform(point))).norm(), 1e-12);
  EXPECT_LT((a.inverse().transform(a.transform(point)) - point).norm(), 1e-12);
  EXPECT_EQ(body_from_camera(Vector3d::UnitZ()), Vector3d::UnitX());
  EXPECT_EQ(camera_from_body(body_from_camera(point)), point);
}

/// Image velocity of a static point by moving the camera: a central difference over 2 h.
Vector2d by_differences(const Vector2d& normalized, double depth, const CameraMotion& motion, double h) {
  const Vector3d point = depth * normalized.homogeneous();
  const auto seen = [&](double t) -> Vector2d {
    const Pose world_camera{rotation_after(motion.angular_velocity_rad_s, t), t * motion.velocity_m_s};
    return world_camera.inverse().transform(point).hnormalized();
  };
  return (seen(h) - seen(-h)) / (2.0 * h);
}

TEST(MotionField, IsEquation14) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> any(-1.0, 1.0);
  for (int i = 0; i < 50; ++i) {
    const Vector2d x(any(random), any(random));
    const double depth = 3.0 + 2.0 * any(random);
    const CameraMotion motion{Vector3d(any(random), any(random), any(random)),
                              Vector3d(any(random), any(random), any(random))};
    EXPECT_LT((motion_field(x, 1.0 / depth, motion) - by_differences(x, depth, motion, 1e-5)).norm(), 1e-8);
  }
}

TEST(MotionField, DenseIsThePointwiseOneInPixels) {
  const Camera camera = wide().resized(32, 24);
  std::vector<float> inverse_depth(32 * 24, 0.25F);
  const CameraMotion motion{{0.1, 0.0, 1.0}, {0.0, 0.2, 0.0}};
  const auto flow = motion_field(camera, inverse_depth, motion, 0.1);
  const Vector2d expected = motion_field(camera.normalize({5, 7}), 0.25, motion) * camera.fx * 0.1;
  EXPECT_NEAR(flow[2 * (7 * 32 + 5)], expected.x(), 1e-5);
  EXPECT_NEAR(flow[2 * (7 * 32 + 5) + 1], expected.y(), 1e-5);
  inverse_depth.pop_back();
  EXPECT_THROW(motion_field(camera, inverse_depth, motion, 0.1), Error);
}

TEST(Derotation, LeavesTheTranslationalFlow) {
  const Camera camera = wide().resized(48, 36);
  const Vector3d omega(0.3, -0.5, 0.4);
  const double dt = 1.0 / 30.0;
  // Pure rotation, exactly: nothing may remain.
  FlowField field;
  field.width = 48;
  field.height = 36;
  for (int v = 0; v < 36; ++v) {
    for (int u = 0; u < 48; ++u) {
      const Vector2d moved = rotate_pixel(camera, {u, v}, omega, dt) - Vector2d(u, v);
      field.flow.push_back(static_cast<float>(moved.x()));
      field.flow.push_back(static_cast<float>(moved.y()));
    }
  }
  EXPECT_GT(std::abs(field.flow[0]), 0.2);
  derotate_flow(camera, omega, dt, field);
  for (const float value : field.flow) {
    EXPECT_NEAR(value, 0.0, 1e-4);
  }
  // To first order rotate_pixel is the rotational part of Eq. 14.
  const Vector2d pixel(40, 3);
  const Vector2d first_order = rotational_flow(camera.normalize(pixel), omega) * camera.fx;
  EXPECT_LT(((rotate_pixel(camera, pixel, omega, 1e-5) - pixel) / 1e-5 - first_order).norm(), 1e-3);
  EXPECT_LT((derotate_pixel(camera, rotate_pixel(camera, pixel, omega, dt), omega, dt) - pixel).norm(), 1e-9);
  EXPECT_THROW(derotate_flow(wide(), omega, dt, field), Error);
}

struct Matches {
  std::vector<Vector2d> begin, end;
};

/// Points of random depth as a translating camera sees them, with noise and a share of wild matches.
Matches approach(const Vector2d& focus, double outliers, double noise_px, int count = 120) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> x(0, 320), y(0, 240), rate(0.02, 0.15), coin(0, 1);
  std::normal_distribution<double> unit;
  Matches matches;
  for (int i = 0; i < count; ++i) {
    const Vector2d begin(x(random), y(random));
    Vector2d end = begin + rate(random) * (begin - focus) + Vector2d(noise_px * unit(random), noise_px * unit(random));
    if (coin(random) < outliers) {
      end = begin + Vector2d(20 * coin(random) - 10, 20 * coin(random) - 10);
    }
    matches.begin.push_back(begin);
    matches.end.push_back(end);
  }
  return matches;
}

TEST(FocusOfExpansion, IsExactWithoutNoise) {
  const Matches matches = approach({200, 90}, 0.0, 0.0);
  const auto focus = focus_of_expansion(matches.begin, matches.end);
  ASSERT_EQ(focus.status, FitStatus::kOk);
  EXPECT_LT((focus.point_px - Vector2d(200, 90)).norm(), 1e-6);
  EXPECT_GE(focus.inliers, 100);
}

TEST(FocusOfExpansion, SurvivesOutliersAndSaysHowSureItIs) {
  for (const double outliers : {0.1, 0.3, 0.45}) {
    const Matches matches = approach({140, 130}, outliers, 0.15);
    const auto focus = focus_of_expansion(matches.begin, matches.end);
    ASSERT_EQ(focus.status, FitStatus::kOk) << outliers;
    const double error = (focus.point_px - Vector2d(140, 130)).norm();
    EXPECT_LT(error, 3.0) << outliers;
    EXPECT_LT(error, 5.0 * std::sqrt(focus.covariance_px2.trace())) << outliers;
  }
}

TEST(FocusOfExpansion, FailsOpenly) {
  EXPECT_EQ(focus_of_expansion({}, {}).status, FitStatus::kTooFewPoints);
  Matches still = approach({100, 100}, 0.0, 0.0);
  still.end = still.begin;
  EXPECT_EQ(focus_of_expansion(still.begin, still.end).status, FitStatus::kTooFewPoints);
  Matches sideways = still;
  for (auto& end : sideways.end) {
    end += Vector2d(5, 0);
  }
  EXPECT_EQ(focus_of_expansion(sideways.begin, sideways.end).status, FitStatus::kIllConditioned);
  const Matches wild = approach({100, 100}, 1.0, 0.0);
  EXPECT_NE(focus_of_expansion(wild.begin, wild.end).status, FitStatus::kOk);
  still.end[3].x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(focus_of_expansion(still.begin, still.end), Error);
  still.end.pop_back();
  EXPECT_THROW(focus_of_expansion(still.begin, still.end), Error);
  FitOptions options;
  options.inlier_px = 0.0;
  EXPECT_THROW(focus_of_expansion({}, {}, options), Error);
}

TEST(Expansion, FindsRateFocusAndItsOwnUncertainty) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> x(40, 280), y(30, 210), coin(0, 1);
  std::normal_distribution<double> noise(0, 0.2);
  const double scale = 1.05;
  const Vector2d focus(150, 100);
  Matches matches;
  for (int i = 0; i < 80; ++i) {
    const Vector2d begin(x(random), y(random));
    Vector2d end = focus + scale * (begin - focus) + Vector2d(noise(random), noise(random));
    if (i % 3 == 0) {
      end += Vector2d(15 * coin(random), -12 * coin(random) - 3);
    }
    matches.begin.push_back(begin);
    matches.end.push_back(end);
  }
  FitOptions options;
  options.inlier_px = 1.0;
  const auto fit = fit_expansion(matches.begin, matches.end, options);
  ASSERT_EQ(fit.status, FitStatus::kOk);
  EXPECT_NEAR(fit.magnification(), scale, 0.002);
  ASSERT_TRUE(fit.has_focus());
  EXPECT_LT((fit.focus_px() - focus).norm(), 4.0);
  EXPECT_LT((fit.apply({50, 60}) - (focus + scale * (Vector2d(50, 60) - focus))).norm(), 0.5);
  EXPECT_LT(fit.rate_sigma, 0.002);
}

TEST(Expansion, IsAShiftWhereNothingGrows) {
  Matches matches = approach({0, 0}, 0.0, 0.0, 40);
  for (std::size_t i = 0; i < matches.begin.size(); ++i) {
    matches.end[i] = matches.begin[i] + Vector2d(-3.0, 1.5);
  }
  const auto fit = fit_expansion(matches.begin, matches.end);
  ASSERT_EQ(fit.status, FitStatus::kOk);
  EXPECT_NEAR(fit.rate, 0.0, 1e-9);
  EXPECT_FALSE(fit.has_focus());
  EXPECT_LT((fit.apply({10, 20}) - Vector2d(7.0, 21.5)).norm(), 1e-9);
}

TEST(Expansion, FailsOpenly) {
  EXPECT_EQ(fit_expansion({}, {}).status, FitStatus::kTooFewPoints);
  const std::vector<Vector2d> spot(20, Vector2d(5, 5));
  EXPECT_EQ(fit_expansion(spot, spot).status, FitStatus::kIllConditioned);
  Matches wild = approach({100, 100}, 1.0, 0.0);
  for (std::size_t i = 0; i < wild.end.size(); ++i) {
    wild.end[i] = wild.begin[(37 * i + 11) % wild.begin.size()];
  }
  EXPECT_EQ(fit_expansion(wild.begin, wild.end).status, FitStatus::kNoConsensus);
}

}  // namespace
}  // namespace ajna::geometry
