// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "ajna/control/command.hpp"
#include "ajna/flight/codec.hpp"

// From a Command to what the autopilot is sent. Every output limits values and their rates itself, whatever the policy
// asked for, and has a way of giving the vehicle back.

namespace ajna::flight {

/// The sticks of the four axes, in the order of ArduPilot's default channels.
enum class Axis : std::uint8_t { kRight, kForward, kUp, kYaw };
constexpr std::size_t kAxes = 4;
const char* to_string(Axis axis) noexcept;

/// How one axis of a velocity command becomes a stick's pulse: trim_us + us_per_unit * value, within the limits.
struct StickOptions {
  int channel = 0;            ///< 1 to 18; 0: this axis is never overridden
  double trim_us = 1500.0;    ///< "hold": the autopilot's RCx_TRIM
  double us_per_unit = 0.0;   ///< per m/s (yaw: per rad/s); negative where the stick works the other way round
  double min_us = 1200.0;     ///< never below
  double max_us = 1800.0;     ///< never above
  double rate_us_s = 2000.0;  ///< fastest change
};

struct RcOutputOptions {
  /// Right, forward, up, yaw. ArduPilot's pitch stick flies forward at low pulses.
  std::array<StickOptions, kAxes> sticks = {
      StickOptions{1, 1500.0, 80.0, 1200.0, 1800.0, 2000.0}, StickOptions{2, 1500.0, -80.0, 1200.0, 1800.0, 2000.0},
      StickOptions{3, 1500.0, 120.0, 1350.0, 1650.0, 1000.0}, StickOptions{4, 1500.0, 150.0, 1350.0, 1650.0, 2000.0}};
};
/// Throws Error(kInvalidArgument) that names the first option out of range: limits outside of kMinPulse_us to
/// kMaxPulse_us, a trim outside of the limits, a channel used twice, no channel at all.
void validate(const RcOutputOptions& options);

struct AttitudeOutputOptions {
  double max_tilt_rad = 0.35;
  double tilt_rate_rad_s = 3.0;      ///< fastest change of roll and pitch
  double velocity_gain_per_s = 1.0;  ///< acceleration per m/s of velocity error (or of wanted velocity, if unmeasured)
  double climb_at_full_m_s = 2.5;    ///< climb rate that thrust 1 means: the autopilot's WPNAV_SPEED_UP
  double max_climb_m_s = 1.0;        ///< both ways
  double climb_rate_m_s2 = 3.0;      ///< fastest change of the climb rate
  double max_yaw_rate_rad_s = 1.0;
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const AttitudeOutputOptions& options);

/// What an output may need to know of the vehicle.
struct VehicleMotion {
  std::optional<double> yaw_rad;                ///< heading; nothing where it is not known or old
  std::optional<Eigen::Vector3d> velocity_m_s;  ///< levelled body frame
};

/// Limits and encodes commands. Not thread-safe.
class CommandOutput {
 public:
  virtual ~CommandOutput() = default;
  CommandOutput() = default;
  CommandOutput(const CommandOutput&) = delete;
  CommandOutput& operator=(const CommandOutput&) = delete;

  /// The frame that brings the vehicle closer to `command`, as far as the limits let it in dt_s seconds; nothing for a
  /// command that is not finite, or where the vehicle's motion would be needed and is not known.
  virtual std::optional<Bytes> command(MavlinkCodec& codec, const control::Command& command, double dt_s,
                                       const VehicleMotion& motion, std::uint32_t time_boot_ms) = 0;
  /// The frame that gives the vehicle back.
  virtual Bytes release(MavlinkCodec& codec, const VehicleMotion& motion, std::uint32_t time_boot_ms) = 0;
  /// Forget where the rate limits stood: the next command begins at hold.
  virtual void reset() noexcept = 0;
  /// The pulses of the last command (0: channel not overridden), where the output works by RC channels.
  [[nodiscard]] virtual std::optional<RcWire> last_pulses() const = 0;
  /// Whether `channel` (1 to 18) is overridden.
  [[nodiscard]] virtual bool uses_channel(int channel) const noexcept = 0;
};

/// RC_CHANNELS_OVERRIDE: the paper's way; velocities as stick deflections in LOITER.
std::unique_ptr<CommandOutput> make_rc_output(const RcOutputOptions& options);
/// SET_ATTITUDE_TARGET: for GUIDED and GUIDED_NOGPS. Released by a level attitude without climb, and then silence, upon
/// which the autopilot's GUID_TIMEOUT does the same: the pilot takes over by the mode switch.
std::unique_ptr<CommandOutput> make_attitude_output(const AttitudeOutputOptions& options);

}  // namespace ajna::flight
