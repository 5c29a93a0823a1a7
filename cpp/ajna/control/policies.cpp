// SPDX-License-Identifier: MIT
#include "ajna/control/policies.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna::control {
namespace {

void require(bool valid, const char* what) {
  if (!valid) {
    throw_invalid(what);
  }
}

/// Seconds since the last call; 0 on the first.
double elapsed(const std::optional<double>& last_s, double time_s) { return last_s ? time_s - *last_s : 0.0; }

bool advances(const std::optional<double>& last_s, double time_s) {
  return std::isfinite(time_s) && (!last_s || time_s > *last_s);
}

/// A first command may change from nothing by what this long allows.
constexpr double kFirstStep_s = 0.03;

/// A first step has no interval: the controllers take any positive one for their proportional part.
double step_of(double elapsed_s) { return elapsed_s > 0.0 ? elapsed_s : 1e-3; }

}  // namespace

// --- Dodge -----------------------------------------------------------------------------------------------------------

DodgePolicy::DodgePolicy(const DodgePolicyOptions& options) : options_(options) {
  require(options.burst_m_s2 >= 0.0 && options.longest_s > 0.0 && options.settle_s >= 0.0,
          "dodge policy: give a burst_m_s2 and settle_s of at least 0 and a positive longest_s");
  require(
      options.speed_m_s > 0.0 && options.hold_s >= 0.0 && options.max_down_m_s >= 0.0 && options.max_turn_rad >= 0.0,
      "dodge policy: give a positive speed_m_s and hold_s, max_down_m_s and max_turn_rad of at least 0");
}

void DodgePolicy::reset() noexcept {
  until_s_.reset();
  ended_s_.reset();
  last_s_.reset();
  last_ = Command::hold();
}

Command DodgePolicy::update(const std::optional<Eigen::Vector2d>& safe_direction, double time_s) {
  if (!advances(last_s_, time_s)) {
    return last_;
  }
  last_s_ = time_s;
  if (until_s_ && time_s > std::min(*until_s_, began_s_ + options_.longest_s)) {
    until_s_.reset();
    ended_s_ = time_s;
  }
  if (safe_direction && safe_direction->allFinite() && safe_direction->norm() > 0.0) {
    const Eigen::Vector2d wanted = safe_direction->normalized();
    if (!until_s_) {
      if (!ended_s_ || time_s - *ended_s_ >= options_.settle_s) {
        direction_ = wanted;
        began_s_ = time_s;
        until_s_ = time_s + options_.hold_s;
      }
    } else if (wanted.dot(direction_) >= std::cos(options_.max_turn_rad)) {
      until_s_ = time_s + options_.hold_s;  // confirmed: go on as begun
    }
  }
  if (!until_s_) {
    return last_ = Command::hold();
  }
  Eigen::Vector3d velocity(0.0, options_.speed_m_s * direction_.x(), options_.speed_m_s * direction_.y());
  velocity.z() = std::min(velocity.z(), options_.max_down_m_s);
  last_ = Command::velocity(velocity);
  const double burst_s = options_.burst_m_s2 > 0.0 ? options_.speed_m_s / options_.burst_m_s2 : 0.0;
  if (time_s - began_s_ < burst_s) {
    last_.mode = CommandMode::kAcceleration;
    last_.acceleration_m_s2 = velocity / burst_s;
  }
  return last_;
}

// --- Navigate --------------------------------------------------------------------------------------------------------

NavigatePolicyOptions::NavigatePolicyOptions() {
  direction.kp = 14.0 / 4.8;
  direction.ki = 0.5 / 4.8;
  direction.kd = 0.3 / 4.8;
  direction.output_min = -8.0;
  direction.output_max = 8.0;
  yaw.kp = 2.0;
  yaw.kd = 0.05;
  yaw.output_min = -1.2;
  yaw.output_max = 1.2;
}

Eigen::Vector3d desired_direction(const Guidance& guidance) {
  require(guidance.weight >= 0.0 && guidance.weight <= 1.0, "guidance weight: give a number from 0 to 1");
  require(guidance.goal.allFinite() && guidance.free.allFinite() && guidance.goal.norm() > 0.0 &&
              guidance.free.norm() > 0.0,
          "guidance directions: give finite vectors other than 0");
  const Eigen::Vector3d goal = guidance.goal.normalized();
  const Eigen::Vector3d sum = (1.0 - guidance.weight) * goal + guidance.weight * guidance.free.normalized();
  return sum.norm() > 1e-9 ? Eigen::Vector3d(sum.normalized()) : goal;
}

NavigatePolicy::NavigatePolicy(const NavigatePolicyOptions& options)
    : options_(options), direction_(options.direction), yaw_(options.yaw) {
  require(options.speed_m_s > 0.0 && options.max_acceleration_m_s2 > 0.0 && options.max_forward_m_s2 > 0.0 &&
              options.max_jerk_m_s3 > 0.0 && options.lookahead_s >= 0.0,
          "navigate policy: give a positive speed_m_s, max_acceleration_m_s2, max_forward_m_s2 and max_jerk_m_s3 and a "
          "lookahead_s of at least 0");
  require(options.slow_down >= 0.0 && options.slow_down < 1.0, "navigate policy: give slow_down from 0 to below 1");
  require(options.weave >= 0.0 && options.weave_hz >= 0.0, "navigate policy: give weave and weave_hz from 0");
  require(options.speed_up_s > 0.0, "navigate policy: give a positive speed_up_s");
  require(options.delay_s >= 0.0 && options.delay_s <= 2.0, "navigate policy: give delay_s from 0 to 2");
}

void NavigatePolicy::reset() noexcept {
  direction_.reset();
  yaw_.reset();
  given_.clear();
  answered_s_.reset();
  last_s_.reset();
  swung_s_ = 0.0;
  last_ = Command::hold();
}

Command NavigatePolicy::update(const std::optional<Guidance>& guidance, double time_s,
                               const std::optional<Eigen::Vector3d>& velocity_m_s) {
  if (!advances(last_s_, time_s)) {
    return last_;
  }
  const double dt_s = step_of(elapsed(last_s_, time_s));
  last_s_ = time_s;
  if (guidance) {
    guidance_ = *guidance;
    answered_s_ = time_s;
  }
  if (!answered_s_ || time_s - *answered_s_ > options_.lookahead_s) {
    direction_.reset();
    yaw_.reset();
    given_.clear();
    return last_ = Command::hold();
  }
  const Eigen::Vector3d desired = desired_direction(guidance_);
  const double speed =
      std::clamp(guidance_.speed_m_s.value_or(options_.speed_m_s * (1.0 - options_.slow_down * guidance_.weight)), 0.0,
                 options_.speed_m_s);
  // Eq. 4 times the cruise speed, so that the loop is as quick at any speed: per m/s of velocity.
  Eigen::Vector3d wanted = speed * desired;
  const bool measured = velocity_m_s && velocity_m_s->allFinite();
  if (measured) {
    // Less when it slows down, and none where it stops.
    const double swing = options_.weave * std::min(options_.speed_m_s, 2.0 * speed);
    wanted.y() += swing * std::cos(2.0 * M_PI * options_.weave_hz * swung_s_);
    swung_s_ += dt_s;
  }
  // Velocity and heading when the command will act.
  const Pending coming = pending(time_s);
  const Eigen::Vector3d current =
      measured ? Eigen::Vector3d(*velocity_m_s + coming.gained_m_s) : Eigen::Vector3d(speed, 0.0, 0.0);
  Command command;
  command.mode = CommandMode::kAcceleration;
  command.velocity_m_s = speed * desired;
  Eigen::Vector3d asked = direction_.update(wanted - current, dt_s);
  asked.x() = std::min({asked.x(), options_.max_forward_m_s2, options_.speed_m_s / options_.speed_up_s});
  asked = Eigen::AngleAxisd(-coming.turned_rad, Eigen::Vector3d::UnitZ()) *
          limit_norm(asked, options_.max_acceleration_m_s2);
  command.acceleration_m_s2 =
      last_.acceleration_m_s2 +
      limit_norm(asked - last_.acceleration_m_s2, options_.max_jerk_m_s3 * std::max(dt_s, kFirstStep_s));
  command.yaw_rate_rad_s = yaw_.update(std::atan2(desired.y(), desired.x()) - coming.turned_rad, dt_s);
  if (options_.delay_s > 0.0) {
    while (given_.size() > 1 && given_[1].time_s <= time_s - options_.delay_s) {
      given_.pop_front();
    }
    given_.push_back({time_s, command.acceleration_m_s2, command.yaw_rate_rad_s});
  }
  return last_ = command;
}

NavigatePolicy::Pending NavigatePolicy::pending(double time_s) const {
  const double since_s = time_s - options_.delay_s;
  Pending sum;
  for (std::size_t i = 0; i < given_.size(); ++i) {
    const double until_s = i + 1 < given_.size() ? given_[i + 1].time_s : time_s;
    const double lasting_s = std::max(0.0, until_s - std::max(given_[i].time_s, since_s));
    const Eigen::Vector3d gained_m_s = lasting_s * given_[i].acceleration_m_s2;
    sum.gained_m_s += gained_m_s;
    sum.moved_m += (time_s - until_s + 0.5 * lasting_s) * gained_m_s;
    sum.turned_rad += lasting_s * given_[i].yaw_rate_rad_s;
  }
  return sum;
}

// --- Gap -------------------------------------------------------------------------------------------------------------

const char* to_string(ExploreKind kind) noexcept {
  return kind == ExploreKind::kDiagonal ? "diagonal" : "excited_hover";
}

Command explore(const ExploreOptions& options, double elapsed_s) {
  require(options.speed_m_s > 0.0 && options.duration_s > 0.0 && options.frequency_hz > 0.0,
          "exploratory manoeuvre: give a positive speed_m_s, duration_s and frequency_hz");
  if (!(elapsed_s >= 0.0 && elapsed_s < options.duration_s)) {
    return Command::hold();
  }
  if (options.kind == ExploreKind::kDiagonal) {
    const double part = options.speed_m_s / std::sqrt(2.0);
    return Command::velocity({0.0, part, -part});
  }
  const double phase = 2.0 * M_PI * options.frequency_hz * elapsed_s;
  constexpr double kIncommensurate = 1.618;
  const double part = options.speed_m_s / std::sqrt(2.0);
  return Command::velocity({0.0, part * std::cos(phase), -part * std::cos(kIncommensurate * phase)});
}

GapPolicyOptions::GapPolicyOptions() {
  servo.kp = 2.0;
  servo.ki = 0.1;
  servo.kd = 0.1;
  servo.output_min = -1.0;
  servo.output_max = 1.0;
}

GapPolicy::GapPolicy(const GapPolicyOptions& options) : options_(options), right_(options.servo), down_(options.servo) {
  require(options.forward_m_s > 0.0 && options.coast_m_s > 0.0 && options.coast_duration_s >= 0.0 &&
              options.lost_hold_s >= 0.0,
          "gap policy: give positive speeds and durations of at least 0");
  require(options.aligned > 0.0 && options.realign >= options.aligned,
          "gap policy: give a positive aligned and a realign of at least aligned");
}

void GapPolicy::reset() noexcept {
  right_.reset();
  down_.reset();
  advancing_ = finished_ = false;
  through_since_s_.reset();
  seen_s_.reset();
  last_s_.reset();
  last_ = Command::hold();
}

Command GapPolicy::update(const std::optional<Eigen::Vector2d>& offset, bool through, double time_s) {
  if (!advances(last_s_, time_s)) {
    return last_;
  }
  const double dt_s = step_of(elapsed(last_s_, time_s));
  last_s_ = time_s;
  if (through && !through_since_s_) {
    through_since_s_ = time_s;
  }
  if (through_since_s_) {
    finished_ = time_s - *through_since_s_ >= options_.coast_duration_s;
    return last_ = finished_ ? Command::hold() : Command::velocity({options_.coast_m_s, 0.0, 0.0});
  }
  if (!offset || !offset->allFinite()) {
    if (!seen_s_ || time_s - *seen_s_ > options_.lost_hold_s) {
      right_.reset();
      down_.reset();
      advancing_ = false;
      last_ = Command::hold();
    }
    return last_;
  }
  seen_s_ = time_s;
  const double distance = offset->norm();
  advancing_ = distance < (advancing_ ? options_.realign : options_.aligned);
  const double forward = advancing_ ? options_.forward_m_s * (1.0 - distance / options_.realign) : 0.0;
  return last_ = Command::velocity({forward, right_.update(offset->x(), dt_s), down_.update(offset->y(), dt_s)});
}

}  // namespace ajna::control
