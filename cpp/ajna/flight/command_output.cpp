// SPDX-License-Identifier: MIT
#include "ajna/flight/command_output.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/base/range.hpp"

namespace ajna::flight {
namespace {

constexpr double kGravity_m_s2 = 9.80665;
/// A longer pause than this does not let a rate-limited value jump.
constexpr double kMaxStep_s = 0.1;

double approach(double from, double to, double max_change) {
  return from + std::clamp(to - from, -max_change, max_change);
}

bool is_finite(const control::Command& command) {
  return command.velocity_m_s.allFinite() && command.acceleration_m_s2.allFinite() &&
         std::isfinite(command.yaw_rate_rad_s);
}

double step_of(double dt_s) { return std::isfinite(dt_s) ? std::clamp(dt_s, 0.0, kMaxStep_s) : 0.0; }

void require(bool valid, const std::string& message) {
  if (!valid) {
    throw_invalid(message);
  }
}

class RcOutput final : public CommandOutput {
 public:
  explicit RcOutput(const RcOutputOptions& options) : options_(options) {
    validate(options);
    RcOutput::reset();
  }

  std::optional<Bytes> command(MavlinkCodec& codec, const control::Command& command, double dt_s,
                               const VehicleMotion& /*motion*/, std::uint32_t /*time_boot_ms*/) override {
    if (!is_finite(command)) {
      return std::nullopt;
    }
    // Of an acceleration command the velocity that it aims at: sticks in LOITER ask for velocities.
    const std::array<double, kAxes> wanted = {command.velocity_m_s.y(), command.velocity_m_s.x(),
                                              -command.velocity_m_s.z(), command.yaw_rate_rad_s};
    ChannelCommands channels{};
    for (std::size_t i = 0; i < kAxes; ++i) {
      const StickOptions& stick = options_.sticks[i];
      if (stick.channel == 0) {
        continue;
      }
      const double value = command.mode == control::CommandMode::kHold ? 0.0 : wanted[i];
      const double target = std::clamp(stick.trim_us + stick.us_per_unit * value, stick.min_us, stick.max_us);
      pulses_us_[i] = approach(pulses_us_[i], target, stick.rate_us_s * step_of(dt_s));
      channels[index_of(stick)] = ChannelCommand::pulse(pulses_us_[i]);
    }
    RcWire sent{};
    for (std::size_t i = 0; i < channels.size(); ++i) {
      sent[i] = channels[i].kind == ChannelCommand::Kind::kPulse ? channels[i].pulse_us : 0;
    }
    sent_ = sent;
    return codec.rc_override(channels);
  }

  Bytes release(MavlinkCodec& codec, const VehicleMotion& /*motion*/, std::uint32_t /*time_boot_ms*/) override {
    ChannelCommands channels{};
    for (const auto& stick : options_.sticks) {
      if (stick.channel != 0) {
        channels[index_of(stick)] = ChannelCommand::release();
      }
    }
    return codec.rc_override(channels);
  }

  void reset() noexcept override {
    for (std::size_t i = 0; i < kAxes; ++i) {
      pulses_us_[i] = options_.sticks[i].trim_us;
    }
    sent_.reset();
  }

  [[nodiscard]] std::optional<RcWire> last_pulses() const override { return sent_; }
  [[nodiscard]] bool uses_channel(int channel) const noexcept override {
    return std::any_of(options_.sticks.begin(), options_.sticks.end(),
                       [&](const StickOptions& stick) { return stick.channel != 0 && stick.channel == channel; });
  }

 private:
  static std::size_t index_of(const StickOptions& stick) { return static_cast<std::size_t>(stick.channel - 1); }

  RcOutputOptions options_;
  std::array<double, kAxes> pulses_us_{};
  std::optional<RcWire> sent_;
};

class AttitudeOutput final : public CommandOutput {
 public:
  explicit AttitudeOutput(const AttitudeOutputOptions& options) : options_(options) { validate(options); }

  std::optional<Bytes> command(MavlinkCodec& codec, const control::Command& command, double dt_s,
                               const VehicleMotion& motion, std::uint32_t time_boot_ms) override {
    // The message's heading is absolute: without the vehicle's own one, any number would turn it.
    if (!is_finite(command) || !motion.yaw_rad || !std::isfinite(*motion.yaw_rad)) {
      return std::nullopt;
    }
    const double dt = step_of(dt_s);
    const Eigen::Vector3d acceleration = acceleration_of(command, motion);
    const double tilt_change = options_.tilt_rate_rad_s * dt;
    const auto tilt = [&](double value) {
      return std::clamp(std::atan2(value, kGravity_m_s2), -options_.max_tilt_rad, options_.max_tilt_rad);
    };
    roll_ = approach(roll_, tilt(acceleration.y()), tilt_change);
    pitch_ = approach(pitch_, -tilt(acceleration.x()), tilt_change);
    const double climb = command.mode == control::CommandMode::kHold
                             ? 0.0
                             : std::clamp(-command.velocity_m_s.z(), -options_.max_climb_m_s, options_.max_climb_m_s);
    climb_ = approach(climb_, climb, options_.climb_rate_m_s2 * dt);
    const double yaw_rate =
        std::clamp(command.yaw_rate_rad_s, -options_.max_yaw_rate_rad_s, options_.max_yaw_rate_rad_s);
    // Ahead of the present heading by what it should turn in the time that the autopilot takes to follow.
    constexpr double kYawLead_s = 0.2;
    const double yaw = yaw_rate == 0.0 ? hold_yaw_.value_or(*motion.yaw_rad) : *motion.yaw_rad + yaw_rate * kYawLead_s;
    hold_yaw_ = yaw_rate == 0.0 ? yaw : *motion.yaw_rad;
    return codec.attitude_target({roll_, pitch_, yaw, thrust(climb_)}, time_boot_ms);
  }

  Bytes release(MavlinkCodec& codec, const VehicleMotion& motion, std::uint32_t time_boot_ms) override {
    const double yaw = hold_yaw_.value_or(motion.yaw_rad.value_or(0.0));
    return codec.attitude_target({0.0, 0.0, yaw, thrust(0.0)}, time_boot_ms);
  }

  void reset() noexcept override {
    roll_ = pitch_ = climb_ = 0.0;
    hold_yaw_.reset();
  }

  [[nodiscard]] std::optional<RcWire> last_pulses() const override { return std::nullopt; }
  [[nodiscard]] bool uses_channel(int /*channel*/) const noexcept override { return false; }

 private:
  [[nodiscard]] Eigen::Vector3d acceleration_of(const control::Command& command, const VehicleMotion& motion) const {
    switch (command.mode) {
      case control::CommandMode::kAcceleration:
        return command.acceleration_m_s2;
      case control::CommandMode::kVelocity:
        return options_.velocity_gain_per_s *
               (command.velocity_m_s - motion.velocity_m_s.value_or(Eigen::Vector3d::Zero()));
      case control::CommandMode::kHold:
        break;
    }
    // Holding without position: brake where the velocity is known, else level.
    return motion.velocity_m_s ? Eigen::Vector3d(-options_.velocity_gain_per_s * *motion.velocity_m_s)
                               : Eigen::Vector3d(Eigen::Vector3d::Zero());
  }
  [[nodiscard]] double thrust(double climb_m_s) const {
    return std::clamp(0.5 + 0.5 * climb_m_s / options_.climb_at_full_m_s, 0.0, 1.0);
  }

  AttitudeOutputOptions options_;
  double roll_ = 0.0;
  double pitch_ = 0.0;
  double climb_ = 0.0;
  std::optional<double> hold_yaw_;
};

}  // namespace

const char* to_string(Axis axis) noexcept {
  switch (axis) {
    case Axis::kRight:
      return "right";
    case Axis::kForward:
      return "forward";
    case Axis::kUp:
      return "up";
    case Axis::kYaw:
      return "yaw";
  }
  return "unknown";
}

void validate(const RcOutputOptions& options) {
  std::vector<int> used;
  for (std::size_t i = 0; i < kAxes; ++i) {
    const StickOptions& stick = options.sticks[i];
    const std::string name = std::string("rc.") + to_string(static_cast<Axis>(i)) + ".";
    require(stick.channel >= 0 && stick.channel <= kRcChannels,
            name + "channel " + std::to_string(stick.channel) + ": give 1 to 18, or 0 for an axis left to the pilot");
    if (stick.channel == 0) {
      continue;
    }
    require(std::find(used.begin(), used.end(), stick.channel) == used.end(),
            name + "channel " + std::to_string(stick.channel) + " is used by two axes: give each its own");
    used.push_back(stick.channel);
    require(stick.min_us >= kMinPulse_us && stick.max_us <= kMaxPulse_us && stick.min_us < stick.max_us,
            name + "min_us and max_us: give limits within 1000 to 2000, the smaller one first");
    require(stick.trim_us >= stick.min_us && stick.trim_us <= stick.max_us,
            name + "trim_us: give a value between min_us and max_us");
    require(std::isfinite(stick.us_per_unit) && std::abs(stick.us_per_unit) <= 1000.0,
            name + "us_per_unit: give -1000 to 1000");
    require(stick.rate_us_s > 0.0 && stick.rate_us_s <= 1e5, name + "rate_us_s: give above 0 and at most 100000");
  }
  require(!used.empty(), "rc: give at least one axis a channel");
}

void validate(const AttitudeOutputOptions& options) {
  require_between("attitude.max_tilt_rad", options.max_tilt_rad, 0.01, 0.8);
  require_between("attitude.tilt_rate_rad_s", options.tilt_rate_rad_s, 0.1, 20.0);
  require_between("attitude.velocity_gain_per_s", options.velocity_gain_per_s, 0.01, 10.0);
  require_between("attitude.climb_at_full_m_s", options.climb_at_full_m_s, 0.1, 20.0);
  require_between("attitude.max_climb_m_s", options.max_climb_m_s, 0.0, 10.0);
  require_between("attitude.climb_rate_m_s2", options.climb_rate_m_s2, 0.1, 50.0);
  require_between("attitude.max_yaw_rate_rad_s", options.max_yaw_rate_rad_s, 0.0, 6.0);
}

std::unique_ptr<CommandOutput> make_rc_output(const RcOutputOptions& options) {
  return std::make_unique<RcOutput>(options);
}

std::unique_ptr<CommandOutput> make_attitude_output(const AttitudeOutputOptions& options) {
  return std::make_unique<AttitudeOutput>(options);
}

}  // namespace ajna::flight
