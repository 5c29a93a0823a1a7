// SPDX-License-Identifier: MIT
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "ajna/flight/rc_channels.hpp"

// MAVLink 2 frames to and from plain structs. The generated C headers stay in codec.cpp.

namespace ajna::flight {

/// Who we are and whom we talk to.
struct MavlinkIds {
  int system_id = 255;       ///< ours: the autopilot's MAV_GCS_SYSID (SYSID_MYGCS), or it drops overrides silently
  int component_id = 191;    ///< ours: MAV_COMP_ID_ONBOARD_COMPUTER
  int target_system = 1;     ///< the autopilot's MAV_SYSID (SYSID_THISMAV)
  int target_component = 1;  ///< MAV_COMP_ID_AUTOPILOT1
};

/// MAVLink 2 message signing.
struct SigningKey {
  std::array<std::uint8_t, 32> secret{};
  std::uint64_t timestamp_10us = 0;  ///< 10 us units since 2015-01-01 UTC; must not be behind the autopilot's
};

struct HeartbeatMessage {
  int type = 0;       ///< MAV_TYPE
  int autopilot = 0;  ///< MAV_AUTOPILOT
  bool armed = false;
  std::uint32_t custom_mode = 0;
  bool is_ardupilot_copter = false;
  bool failsafe = false;  ///< the autopilot calls its own state critical, an emergency or terminated
};

struct RcChannelsMessage {
  int count = 0;                                      ///< channels that the receiver delivers
  std::array<std::uint16_t, kRcChannels> pulse_us{};  ///< 65535: not there
};

struct AttitudeMessage {
  std::array<double, 3> euler_rad{};    ///< roll, pitch, yaw
  std::array<double, 3> rates_rad_s{};  ///< body: forward, right, down
  std::uint32_t boot_ms = 0;            ///< when, by the autopilot's clock
};

struct VelocityMessage {
  std::array<double, 3> ned_m_s{};  ///< LOCAL_POSITION_NED
};

struct SysStatusMessage {
  bool rc_receiver_enabled = false;
  bool rc_receiver_healthy = false;
};

struct ParameterMessage {
  std::string name;
  double value = 0.0;
};

struct StatusTextMessage {
  int severity = 6;
  std::string text;
};

/// A received frame: who sent it and what it says; std::monostate for kinds that we do not read.
struct Received {
  int system_id = 0;
  int component_id = 0;
  std::variant<std::monostate, HeartbeatMessage, RcChannelsMessage, AttitudeMessage, VelocityMessage, SysStatusMessage,
               ParameterMessage, StatusTextMessage>
      message;
};

/// Target of SET_ATTITUDE_TARGET: attitude and climb; body rates are always ignored.
struct AttitudeTarget {
  double roll_rad = 0.0;
  double pitch_rad = 0.0;
  double yaw_rad = 0.0;  ///< absolute heading
  double thrust = 0.5;   ///< 0 to 1; 0.5 holds the height (unless the autopilot's GUID_OPTIONS say otherwise)
};

/// Messages whose rate we ask the autopilot for.
enum class Stream { kHeartbeat, kRc, kAttitude, kSysStatus, kLocalPosition };

using Bytes = std::vector<std::uint8_t>;

/// Encodes and decodes; keeps sequence numbers, parser state and signing. Not thread-safe.
class MavlinkCodec {
 public:
  /// Throws Error(kInvalidArgument) for ids outside 1 to 255.
  explicit MavlinkCodec(const MavlinkIds& ids, const std::optional<SigningKey>& signing = std::nullopt);
  ~MavlinkCodec();
  MavlinkCodec(MavlinkCodec&&) noexcept;
  MavlinkCodec& operator=(MavlinkCodec&&) noexcept;

  /// All whole frames with a right checksum (and signature, where a key is set) that `data` completes; the rest is kept
  /// for the next call. Damaged frames are counted.
  std::vector<Received> decode(const std::uint8_t* data, std::size_t size);
  [[nodiscard]] std::uint64_t bad_frames() const noexcept;

  /// As an onboard controller; `active`: MAV_STATE_ACTIVE while commands go out, else MAV_STATE_STANDBY.
  Bytes heartbeat(bool active);
  Bytes rc_override(const ChannelCommands& commands);
  Bytes attitude_target(const AttitudeTarget& target, std::uint32_t time_boot_ms);
  Bytes request_parameter(const std::string& name);
  /// MAV_CMD_SET_MESSAGE_INTERVAL.
  Bytes request_stream(Stream stream, double rate_hz);
  /// A line for the ground station, cut at 50 characters. severity: MAV_SEVERITY.
  Bytes status_text(int severity, const std::string& text);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Number of an ArduCopter flight mode by its name ("LOITER"). Throws Error(kInvalidArgument) with the nearest name.
std::uint32_t copter_mode(const std::string& name);
/// Its name, or "mode 42".
std::string copter_mode_name(std::uint32_t mode);

}  // namespace ajna::flight
