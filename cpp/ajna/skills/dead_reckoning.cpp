// SPDX-License-Identifier: MIT
#include "ajna/skills/dead_reckoning.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

namespace ajna::skills {
namespace {

constexpr double kLongest_s = 0.5;

Eigen::Vector3d turned(const Eigen::Vector3d& v, double yaw_rad) {
  const double c = std::cos(yaw_rad);
  const double s = std::sin(yaw_rad);
  return {c * v.x() - s * v.y(), s * v.x() + c * v.y(), v.z()};
}

}  // namespace

void DeadReckoning::reset() noexcept {
  middle_m_.setZero();
  position_m_.setZero();
  last_.reset();
  way_.clear();
}

void DeadReckoning::move(double time_s, double yaw_rad, const Eigen::Vector3d& velocity_m_s) {
  const Eigen::Vector3d velocity = turned(velocity_m_s, yaw_rad);
  const double dt_s = last_ ? time_s - last_->time_s : 0.0;
  if (last_ && !(dt_s > 0.0)) {
    return;
  }
  if (last_) {
    middle_m_ += std::min(dt_s, kLongest_s) * 0.5 * (last_->velocity_m_s + velocity);
  }
  if (!last_ || dt_s > kLongest_s) {
    way_.clear();
  }
  last_ = Last{time_s, yaw_rad, velocity};
  position_m_ = middle_m_ + turned({ahead_m_, 0.0, 0.0}, yaw_rad);
  way_.push_back({time_s, position_m_});
  while (way_.size() > 2 && time_s - way_[1].time_s > keep_s_) {
    way_.pop_front();
  }
}

std::optional<Eigen::Vector3d> DeadReckoning::moved_since(double time_s) const {
  constexpr double kSame_s = 1e-6;
  if (!last_ || way_.empty() || time_s < way_.front().time_s - kSame_s || time_s > way_.back().time_s) {
    return std::nullopt;
  }
  const auto later = std::find_if(way_.begin(), way_.end(), [&](const Point& p) { return p.time_s >= time_s; });
  Eigen::Vector3d then = later->at_m;
  if (later != way_.begin()) {
    const Point& earlier = *std::prev(later);
    then = earlier.at_m + (time_s - earlier.time_s) / (later->time_s - earlier.time_s) * (later->at_m - earlier.at_m);
  }
  return turned(position_m_ - then, -last_->yaw_rad);
}

}  // namespace ajna::skills
