// SPDX-License-Identifier: MIT
#include "ajna/flight/codec.hpp"

#include <mavlink/ardupilotmega/mavlink.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::flight {
namespace {

struct NamedMode {
  const char* name;
  std::uint32_t mode;
};
constexpr std::array kModes = {NamedMode{"STABILIZE", COPTER_MODE_STABILIZE},
                               NamedMode{"ACRO", COPTER_MODE_ACRO},
                               NamedMode{"ALT_HOLD", COPTER_MODE_ALT_HOLD},
                               NamedMode{"AUTO", COPTER_MODE_AUTO},
                               NamedMode{"GUIDED", COPTER_MODE_GUIDED},
                               NamedMode{"LOITER", COPTER_MODE_LOITER},
                               NamedMode{"RTL", COPTER_MODE_RTL},
                               NamedMode{"CIRCLE", COPTER_MODE_CIRCLE},
                               NamedMode{"LAND", COPTER_MODE_LAND},
                               NamedMode{"DRIFT", COPTER_MODE_DRIFT},
                               NamedMode{"SPORT", COPTER_MODE_SPORT},
                               NamedMode{"FLIP", COPTER_MODE_FLIP},
                               NamedMode{"AUTOTUNE", COPTER_MODE_AUTOTUNE},
                               NamedMode{"POSHOLD", COPTER_MODE_POSHOLD},
                               NamedMode{"BRAKE", COPTER_MODE_BRAKE},
                               NamedMode{"THROW", COPTER_MODE_THROW},
                               NamedMode{"AVOID_ADSB", COPTER_MODE_AVOID_ADSB},
                               NamedMode{"GUIDED_NOGPS", COPTER_MODE_GUIDED_NOGPS},
                               NamedMode{"SMART_RTL", COPTER_MODE_SMART_RTL},
                               NamedMode{"FLOWHOLD", COPTER_MODE_FLOWHOLD},
                               NamedMode{"FOLLOW", COPTER_MODE_FOLLOW},
                               NamedMode{"ZIGZAG", COPTER_MODE_ZIGZAG},
                               NamedMode{"SYSTEMID", COPTER_MODE_SYSTEMID},
                               NamedMode{"AUTOROTATE", COPTER_MODE_AUTOROTATE},
                               NamedMode{"AUTO_RTL", COPTER_MODE_AUTO_RTL},
                               NamedMode{"TURTLE", COPTER_MODE_TURTLE}};

bool is_copter(int type) {
  switch (type) {
    case MAV_TYPE_QUADROTOR:
    case MAV_TYPE_COAXIAL:
    case MAV_TYPE_HELICOPTER:
    case MAV_TYPE_HEXAROTOR:
    case MAV_TYPE_OCTOROTOR:
    case MAV_TYPE_TRICOPTER:
    case MAV_TYPE_DODECAROTOR:
    case MAV_TYPE_DECAROTOR:
      return true;
    default:
      return false;
  }
}

/// Text of a fixed-width field, which ends at a 0 or at its width.
template <std::size_t kWidth>
std::string text_of(const char (&field)[kWidth]) {
  return {field, strnlen(field, kWidth)};
}

HeartbeatMessage read_heartbeat(const mavlink_message_t& frame) {
  mavlink_heartbeat_t raw;
  mavlink_msg_heartbeat_decode(&frame, &raw);
  HeartbeatMessage message;
  message.type = raw.type;
  message.autopilot = raw.autopilot;
  message.armed = (raw.base_mode & MAV_MODE_FLAG_SAFETY_ARMED) != 0;
  message.custom_mode = raw.custom_mode;
  message.is_ardupilot_copter = raw.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA && is_copter(raw.type);
  message.failsafe = raw.system_status >= MAV_STATE_CRITICAL;
  return message;
}

RcChannelsMessage read_rc_channels(const mavlink_message_t& frame) {
  mavlink_rc_channels_t raw;
  mavlink_msg_rc_channels_decode(&frame, &raw);
  RcChannelsMessage message;
  message.count = raw.chancount;
  message.pulse_us = {raw.chan1_raw,  raw.chan2_raw,  raw.chan3_raw,  raw.chan4_raw,  raw.chan5_raw,  raw.chan6_raw,
                      raw.chan7_raw,  raw.chan8_raw,  raw.chan9_raw,  raw.chan10_raw, raw.chan11_raw, raw.chan12_raw,
                      raw.chan13_raw, raw.chan14_raw, raw.chan15_raw, raw.chan16_raw, raw.chan17_raw, raw.chan18_raw};
  return message;
}

/// What the frame says; nothing of a kind that is not read or holds numbers that are none.
void read_message(const mavlink_message_t& frame, Received& received) {
  switch (frame.msgid) {
    case MAVLINK_MSG_ID_HEARTBEAT:
      received.message = read_heartbeat(frame);
      break;
    case MAVLINK_MSG_ID_RC_CHANNELS:
      received.message = read_rc_channels(frame);
      break;
    case MAVLINK_MSG_ID_ATTITUDE: {
      mavlink_attitude_t raw;
      mavlink_msg_attitude_decode(&frame, &raw);
      const AttitudeMessage message{
          {raw.roll, raw.pitch, raw.yaw}, {raw.rollspeed, raw.pitchspeed, raw.yawspeed}, raw.time_boot_ms};
      const auto finite = [](double value) { return std::isfinite(value); };
      if (std::all_of(message.euler_rad.begin(), message.euler_rad.end(), finite) &&
          std::all_of(message.rates_rad_s.begin(), message.rates_rad_s.end(), finite)) {
        received.message = message;
      }
      break;
    }
    case MAVLINK_MSG_ID_LOCAL_POSITION_NED: {
      mavlink_local_position_ned_t raw;
      mavlink_msg_local_position_ned_decode(&frame, &raw);
      if (std::isfinite(raw.vx) && std::isfinite(raw.vy) && std::isfinite(raw.vz)) {
        received.message = VelocityMessage{{raw.vx, raw.vy, raw.vz}};
      }
      break;
    }
    case MAVLINK_MSG_ID_SYS_STATUS: {
      mavlink_sys_status_t raw;
      mavlink_msg_sys_status_decode(&frame, &raw);
      received.message =
          SysStatusMessage{(raw.onboard_control_sensors_enabled & MAV_SYS_STATUS_SENSOR_RC_RECEIVER) != 0,
                           (raw.onboard_control_sensors_health & MAV_SYS_STATUS_SENSOR_RC_RECEIVER) != 0};
      break;
    }
    case MAVLINK_MSG_ID_PARAM_VALUE: {
      mavlink_param_value_t raw;
      mavlink_msg_param_value_decode(&frame, &raw);
      received.message = ParameterMessage{text_of(raw.param_id), static_cast<double>(raw.param_value)};
      break;
    }
    case MAVLINK_MSG_ID_STATUSTEXT: {
      mavlink_statustext_t raw;
      mavlink_msg_statustext_decode(&frame, &raw);
      received.message = StatusTextMessage{raw.severity, text_of(raw.text)};
      break;
    }
    default:
      break;
  }
}

std::uint8_t checked_id(int id, const char* name) {
  if (id < 1 || id > 255) {
    throw_invalid(std::string(name) + " " + std::to_string(id) + " is out of range: give 1 to 255");
  }
  return static_cast<std::uint8_t>(id);
}

std::uint16_t id_of(Stream stream) {
  switch (stream) {
    case Stream::kHeartbeat:
      return MAVLINK_MSG_ID_HEARTBEAT;
    case Stream::kRc:
      return MAVLINK_MSG_ID_RC_CHANNELS;
    case Stream::kAttitude:
      return MAVLINK_MSG_ID_ATTITUDE;
    case Stream::kSysStatus:
      return MAVLINK_MSG_ID_SYS_STATUS;
    case Stream::kLocalPosition:
      return MAVLINK_MSG_ID_LOCAL_POSITION_NED;
  }
  return 0;
}

}  // namespace

struct MavlinkCodec::Impl {
  std::uint8_t system, component, target_system, target_component;
  mavlink_status_t in{}, out{};
  mavlink_message_t buffer{};
  mavlink_signing_t signing{};
  mavlink_signing_streams_t streams{};
  std::uint64_t bad_frames = 0;

  static Bytes bytes(const mavlink_message_t& message) {
    Bytes result(MAVLINK_MAX_PACKET_LEN);
    result.resize(mavlink_msg_to_send_buffer(result.data(), &message));
    return result;
  }
};

MavlinkCodec::MavlinkCodec(const MavlinkIds& ids, const std::optional<SigningKey>& signing)
    : impl_(std::make_unique<Impl>()) {
  impl_->system = checked_id(ids.system_id, "system_id");
  impl_->component = checked_id(ids.component_id, "component_id");
  impl_->target_system = checked_id(ids.target_system, "target_system");
  impl_->target_component = checked_id(ids.target_component, "target_component");
  if (signing) {
    impl_->signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
    impl_->signing.timestamp = signing->timestamp_10us;
    std::copy(signing->secret.begin(), signing->secret.end(), impl_->signing.secret_key);
    // With no callback for unsigned frames, none is accepted.
    for (auto* status : {&impl_->in, &impl_->out}) {
      status->signing = &impl_->signing;
      status->signing_streams = &impl_->streams;
    }
  }
}

MavlinkCodec::~MavlinkCodec() = default;
MavlinkCodec::MavlinkCodec(MavlinkCodec&&) noexcept = default;
MavlinkCodec& MavlinkCodec::operator=(MavlinkCodec&&) noexcept = default;

std::uint64_t MavlinkCodec::bad_frames() const noexcept { return impl_->bad_frames; }

std::vector<Received> MavlinkCodec::decode(const std::uint8_t* data, std::size_t size) {
  std::vector<Received> received;
  mavlink_message_t frame;
  mavlink_status_t status;
  for (std::size_t i = 0; i < size; ++i) {
    const auto framing = mavlink_frame_char_buffer(&impl_->buffer, &impl_->in, data[i], &frame, &status);
    if (framing == MAVLINK_FRAMING_OK) {
      Received one;
      one.system_id = frame.sysid;
      one.component_id = frame.compid;
      read_message(frame, one);
      received.push_back(std::move(one));
    } else if (framing != MAVLINK_FRAMING_INCOMPLETE) {
      ++impl_->bad_frames;
    }
  }
  return received;
}

Bytes MavlinkCodec::heartbeat(bool active) {
  mavlink_message_t message;
  mavlink_msg_heartbeat_pack_status(impl_->system, impl_->component, &impl_->out, &message, MAV_TYPE_ONBOARD_CONTROLLER,
                                    MAV_AUTOPILOT_INVALID, 0, 0, active ? MAV_STATE_ACTIVE : MAV_STATE_STANDBY);
  return Impl::bytes(message);
}

Bytes MavlinkCodec::rc_override(const ChannelCommands& commands) {
  const RcWire wire = to_wire(commands);
  mavlink_message_t message;
  mavlink_msg_rc_channels_override_pack_status(impl_->system, impl_->component, &impl_->out, &message,
                                               impl_->target_system, impl_->target_component, wire[0], wire[1], wire[2],
                                               wire[3], wire[4], wire[5], wire[6], wire[7], wire[8], wire[9], wire[10],
                                               wire[11], wire[12], wire[13], wire[14], wire[15], wire[16], wire[17]);
  return Impl::bytes(message);
}

Bytes MavlinkCodec::attitude_target(const AttitudeTarget& target, std::uint32_t time_boot_ms) {
  std::array<float, 4> quaternion{};
  mavlink_euler_to_quaternion(static_cast<float>(target.roll_rad), static_cast<float>(target.pitch_rad),
                              static_cast<float>(target.yaw_rad), quaternion.data());
  // ArduPilot takes the three rates together or not at all; some of them would stop the guided mode.
  constexpr std::uint8_t kIgnoreRates = ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE |
                                        ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE |
                                        ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE;
  mavlink_message_t message;
  mavlink_msg_set_attitude_target_pack_status(impl_->system, impl_->component, &impl_->out, &message, time_boot_ms,
                                              impl_->target_system, impl_->target_component, kIgnoreRates,
                                              quaternion.data(), 0.0F, 0.0F, 0.0F,
                                              static_cast<float>(std::clamp(target.thrust, 0.0, 1.0)));
  return Impl::bytes(message);
}

Bytes MavlinkCodec::request_parameter(const std::string& name) {
  std::array<char, 17> id{};
  name.copy(id.data(), 16);
  mavlink_message_t message;
  mavlink_msg_param_request_read_pack_status(impl_->system, impl_->component, &impl_->out, &message,
                                             impl_->target_system, impl_->target_component, id.data(), -1);
  return Impl::bytes(message);
}

Bytes MavlinkCodec::request_stream(Stream stream, double rate_hz) {
  const auto interval_us = static_cast<float>(1e6 / std::clamp(rate_hz, 0.1, 1000.0));
  mavlink_message_t message;
  mavlink_msg_command_long_pack_status(impl_->system, impl_->component, &impl_->out, &message, impl_->target_system,
                                       impl_->target_component, MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                                       static_cast<float>(id_of(stream)), interval_us, 0, 0, 0, 0, 0);
  return Impl::bytes(message);
}

Bytes MavlinkCodec::status_text(int severity, const std::string& text) {
  std::array<char, 51> field{};
  text.copy(field.data(), 50);
  mavlink_message_t message;
  mavlink_msg_statustext_pack_status(impl_->system, impl_->component, &impl_->out, &message,
                                     static_cast<std::uint8_t>(std::clamp(severity, 0, 7)), field.data(), 0, 0);
  return Impl::bytes(message);
}

std::uint32_t copter_mode(const std::string& name) {
  std::vector<std::string> names;
  names.reserve(kModes.size());
  for (const auto& mode : kModes) {
    if (name == mode.name) {
      return mode.mode;
    }
    names.emplace_back(mode.name);
  }
  throw_unknown("flight mode", name, names);
}

std::string copter_mode_name(std::uint32_t mode) {
  for (const auto& known : kModes) {
    if (known.mode == mode) {
      return known.name;
    }
  }
  return "mode " + std::to_string(mode);
}

}  // namespace ajna::flight
