// SPDX-License-Identifier: MIT
#include "ajna/flight/attitude_history.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

namespace ajna::flight {
namespace {

constexpr std::size_t kKept = 512;
constexpr double kAhead_s = 0.1;
constexpr double kApart_s = 0.3;

Eigen::Quaterniond north_from_body(const AttitudeSample& sample) {
  return Eigen::AngleAxisd(sample.euler_rad.z(), Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(sample.euler_rad.y(), Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(sample.euler_rad.x(), Eigen::Vector3d::UnitX());
}

skills::Attitude attitude_of(const Eigen::Matrix3d& north_from_body, double camera_pitch_rad) {
  skills::Attitude attitude;
  attitude.yaw_rad = std::atan2(north_from_body(1, 0), north_from_body(0, 0));
  const double c = std::cos(camera_pitch_rad);
  const double s = std::sin(camera_pitch_rad);
  Eigen::Matrix3d body_from_camera;  // columns: the camera's right, down and forward axes
  body_from_camera << 0, s, c, 1, 0, 0, 0, c, -s;
  attitude.heading_from_camera =
      Eigen::AngleAxisd(-attitude.yaw_rad, Eigen::Vector3d::UnitZ()) * north_from_body * body_from_camera;
  return attitude;
}

}  // namespace

void AttitudeHistory::add(const std::vector<AttitudeSample>& samples) {
  const std::lock_guard lock(mutex_);
  for (const auto& sample : samples) {
    if (samples_.empty() || sample.time_s > samples_.back().time_s) {
      samples_.push_back(sample);
    } else {
      samples_.back() = sample;  // two in one tick: the later one counts
    }
  }
  while (samples_.size() > kKept) {
    samples_.pop_front();
  }
}

std::optional<skills::Attitude> AttitudeHistory::at(double time_s, double camera_pitch_rad) const {
  const std::lock_guard lock(mutex_);
  if (samples_.empty() || !(time_s >= samples_.front().time_s && time_s <= samples_.back().time_s + kAhead_s)) {
    return std::nullopt;
  }
  const auto after = std::upper_bound(samples_.begin(), samples_.end(), time_s,
                                      [](double time, const AttitudeSample& sample) { return time < sample.time_s; });
  const AttitudeSample& before = *(after - 1);
  if (after == samples_.end()) {
    const Eigen::Vector3d turn = before.rates_rad_s * (time_s - before.time_s);
    const double angle = turn.norm();
    const Eigen::Quaterniond on(Eigen::AngleAxisd(
        angle, angle > 0.0 ? Eigen::Vector3d(turn / angle) : Eigen::Vector3d(Eigen::Vector3d::UnitX())));
    return attitude_of((north_from_body(before) * on).toRotationMatrix(), camera_pitch_rad);
  }
  if (after->time_s - before.time_s > kApart_s) {
    return std::nullopt;
  }
  const double share = (time_s - before.time_s) / (after->time_s - before.time_s);
  return attitude_of(north_from_body(before).slerp(share, north_from_body(*after)).toRotationMatrix(),
                     camera_pitch_rad);
}

}  // namespace ajna::flight
