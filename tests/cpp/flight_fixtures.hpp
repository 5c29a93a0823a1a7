// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>
#include <mavlink/ardupilotmega/mavlink.h>

#include <array>
#include <cstdint>
#include <cstring>
#include <deque>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "ajna/flight/transport.hpp"

namespace ajna::flight {

/// All frames in a run of bytes, by the official parser.
inline std::vector<mavlink_message_t> parse_all(const std::vector<std::uint8_t>& bytes) {
  std::vector<mavlink_message_t> messages;
  mavlink_message_t buffer{};
  mavlink_status_t state{};
  mavlink_message_t message;
  mavlink_status_t status;
  for (const std::uint8_t byte : bytes) {
    if (mavlink_frame_char_buffer(&buffer, &state, byte, &message, &status) == MAVLINK_FRAMING_OK) {
      messages.push_back(message);
    }
  }
  return messages;
}

/// The one frame that `bytes` must be.
inline mavlink_message_t only(const std::vector<std::uint8_t>& bytes) {
  const auto messages = parse_all(bytes);
  EXPECT_EQ(messages.size(), 1U);
  return messages.empty() ? mavlink_message_t{} : messages.front();
}

inline std::array<std::uint16_t, 18> override_of(const mavlink_message_t& message) {
  mavlink_rc_channels_override_t raw;
  mavlink_msg_rc_channels_override_decode(&message, &raw);
  return {raw.chan1_raw,  raw.chan2_raw,  raw.chan3_raw,  raw.chan4_raw,  raw.chan5_raw,  raw.chan6_raw,
          raw.chan7_raw,  raw.chan8_raw,  raw.chan9_raw,  raw.chan10_raw, raw.chan11_raw, raw.chan12_raw,
          raw.chan13_raw, raw.chan14_raw, raw.chan15_raw, raw.chan16_raw, raw.chan17_raw, raw.chan18_raw};
}

/// Both ends in memory.
class MemoryTransport final : public Transport {
 public:
  std::deque<std::uint8_t> incoming;
  std::vector<std::uint8_t> outgoing;
  bool broken = false;
  bool open = true;

  void service(double /*now_s*/) noexcept override {}
  std::size_t read(std::uint8_t* data, std::size_t size) noexcept override {
    std::size_t count = 0;
    for (; count < size && !incoming.empty(); ++count) {
      data[count] = incoming.front();
      incoming.pop_front();
    }
    return count;
  }
  bool write(const std::uint8_t* data, std::size_t size) noexcept override {
    if (broken) {
      return false;
    }
    outgoing.insert(outgoing.end(), data, data + size);
    return true;
  }
  [[nodiscard]] bool is_open() const noexcept override { return open; }
  [[nodiscard]] int descriptor() const noexcept override { return -1; }
  [[nodiscard]] std::string problem() const override { return {}; }
};

/// An ArduPilot copter, as far as the link sees it: streams, parameters, and overrides that it follows or not.
class SimulatedAutopilot {
 public:
  std::map<std::string, float> parameters = {{"SYSID_MYGCS", 255}, {"RC_OVERRIDE_TIME", 1.0F}, {"RC_OPTIONS", 32}};
  bool armed = true;
  std::uint32_t mode = COPTER_MODE_LOITER;
  std::uint8_t state = MAV_STATE_ACTIVE;
  std::uint8_t system_id = 1;
  int switch_us = 1000;
  int switch_channel = 8;
  bool silent = false;
  bool follows = true;
  bool receiver_healthy = true;

  std::vector<mavlink_message_t> heard;  ///< all that came

  /// What happens in a tick at `now_s`: it reads what was written and sends what is due.
  void run(double now_s, MemoryTransport& pipe) {
    for (const auto& message : parse_all(pipe.outgoing)) {
      heard.push_back(message);
      take(message);
    }
    pipe.outgoing.clear();
    if (silent) {
      return;
    }
    if (due(now_s, heartbeat_s_, heartbeat_every_s_)) {
      mavlink_message_t m;
      const std::uint8_t base = MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (armed ? MAV_MODE_FLAG_SAFETY_ARMED : 0);
      mavlink_msg_heartbeat_pack_status(system_id, 1, &status_, &m, MAV_TYPE_QUADROTOR, MAV_AUTOPILOT_ARDUPILOTMEGA,
                                        base, mode, state);
      send(m, pipe);
      const std::uint32_t health = receiver_healthy ? std::uint32_t{MAV_SYS_STATUS_SENSOR_RC_RECEIVER} : 0U;
      mavlink_msg_sys_status_pack_status(system_id, 1, &status_, &m, MAV_SYS_STATUS_SENSOR_RC_RECEIVER,
                                         MAV_SYS_STATUS_SENSOR_RC_RECEIVER, health, 0, 12000, 0, 90, 0, 0, 0, 0, 0, 0,
                                         0, 0, 0);
      send(m, pipe);
    }
    if (due(now_s, rc_s_, 0.04)) {
      auto rc = sticks_;
      for (std::size_t i = 0; i < rc.size(); ++i) {
        rc[i] = follows && override_[i] != 0 ? override_[i] : rc[i];
      }
      rc[static_cast<std::size_t>(switch_channel - 1)] = static_cast<std::uint16_t>(switch_us);
      mavlink_message_t m;
      mavlink_msg_rc_channels_pack_status(system_id, 1, &status_, &m, 0, 16, rc[0], rc[1], rc[2], rc[3], rc[4], rc[5],
                                          rc[6], rc[7], rc[8], rc[9], rc[10], rc[11], rc[12], rc[13], rc[14], rc[15],
                                          65535, 65535, 200);
      send(m, pipe);
      mavlink_msg_attitude_pack_status(system_id, 1, &status_, &m, 0, 0.0F, 0.0F, 1.0F, 0.1F, 0.2F, 0.3F);
      send(m, pipe);
    }
    for (const auto& name : asked_) {
      if (const auto found = parameters.find(name); found != parameters.end()) {
        std::array<char, 17> id{};
        name.copy(id.data(), 16);
        mavlink_message_t m;
        mavlink_msg_param_value_pack_status(system_id, 1, &status_, &m, id.data(), found->second, MAV_PARAM_TYPE_REAL32,
                                            1000, 0);
        send(m, pipe);
      }
    }
    asked_.clear();
  }

  /// 0: not overridden.
  [[nodiscard]] const std::array<std::uint16_t, 18>& overridden() const { return override_; }

 private:
  static bool due(double now_s, double& last_s, double every_s) {
    if (now_s - last_s < every_s - 1e-9) {
      return false;
    }
    last_s = now_s;
    return true;
  }
  static void send(const mavlink_message_t& message, MemoryTransport& pipe) {
    std::array<std::uint8_t, MAVLINK_MAX_PACKET_LEN> bytes{};
    const auto size = mavlink_msg_to_send_buffer(bytes.data(), &message);
    pipe.incoming.insert(pipe.incoming.end(), bytes.begin(), bytes.begin() + size);
  }
  void take(const mavlink_message_t& message) {
    if (message.msgid == MAVLINK_MSG_ID_PARAM_REQUEST_READ) {
      mavlink_param_request_read_t raw;
      mavlink_msg_param_request_read_decode(&message, &raw);
      asked_.emplace_back(raw.param_id, strnlen(raw.param_id, 16));
    } else if (message.msgid == MAVLINK_MSG_ID_COMMAND_LONG) {
      mavlink_command_long_t raw;
      mavlink_msg_command_long_decode(&message, &raw);
      if (raw.command == MAV_CMD_SET_MESSAGE_INTERVAL && raw.param1 == MAVLINK_MSG_ID_HEARTBEAT) {
        heartbeat_every_s_ = 1e-6 * raw.param2;
      }
    } else if (message.msgid == MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE) {
      const auto wire = override_of(message);
      for (std::size_t i = 0; i < wire.size(); ++i) {
        const bool base = i < 8;
        if (wire[i] == 65535 || (!base && wire[i] == 0)) {
          continue;
        }
        override_[i] = (base && wire[i] == 0) || (!base && wire[i] == 65534) ? std::uint16_t{0} : wire[i];
      }
    }
  }

  mavlink_status_t status_{};
  double heartbeat_every_s_ = 1.0;  // until another rate is asked for
  double heartbeat_s_ = -10.0, rc_s_ = -10.0;
  std::array<std::uint16_t, 18> sticks_ = {1500, 1500, 1500, 1500, 1500, 1500, 1500, 1500, 1500,
                                           1500, 1500, 1500, 1500, 1500, 1500, 1500, 0,    0};
  std::array<std::uint16_t, 18> override_{};
  std::vector<std::string> asked_;
};

}  // namespace ajna::flight
