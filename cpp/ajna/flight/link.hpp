// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "ajna/flight/attitude_history.hpp"
#include "ajna/flight/codec.hpp"
#include "ajna/flight/command_output.hpp"
#include "ajna/flight/parameters.hpp"
#include "ajna/flight/sender_clock.hpp"
#include "ajna/flight/transport.hpp"

namespace ajna::flight {

/// What the autopilot has told us; times are monotonic seconds of arrival.
struct VehicleState {
  std::optional<double> heartbeat_s;
  HeartbeatMessage heartbeat;
  std::optional<double> rc_s;
  RcChannelsMessage rc;
  std::optional<double> attitude_s;
  AttitudeMessage attitude;
  std::optional<double> velocity_s;
  VelocityMessage velocity;
  std::optional<double> sys_status_s;
  SysStatusMessage sys_status;

  /// Pulse of a channel (1 to 18), where the receiver delivers it.
  [[nodiscard]] std::optional<int> channel_us(int channel) const;
  /// Heading and velocity where they are at most 0.5 s old.
  [[nodiscard]] VehicleMotion motion(double now_s) const;
};

struct LinkOptions {
  MavlinkIds ids;
  double heartbeat_rate_hz = 10.0;  ///< asked of the autopilot: they tell the mode and whether it is armed
  double rc_rate_hz = 25.0;         ///< likewise, as the others
  double attitude_rate_hz = 50.0;
  double max_override_s = 3.0;  ///< see ParameterCheck
  bool listen_only = false;     ///< write nothing at all
};

/// The conversation with the autopilot: heartbeats, streams, parameters, and the vehicle's state. Owned by one thread.
class Link {
 public:
  Link(std::unique_ptr<Transport> transport, const LinkOptions& options, OutputKind output,
       const std::optional<SigningKey>& signing = std::nullopt);

  /// Read what has come and send what is due: a heartbeat each second, requests until they are answered.
  void service(double now_s, bool active);
  /// False where it could not be written (or in listen_only).
  bool send(const Bytes& frame) noexcept;

  [[nodiscard]] const VehicleState& vehicle() const noexcept { return vehicle_; }
  [[nodiscard]] const ParameterCheck& parameters() const noexcept { return parameters_; }
  [[nodiscard]] MavlinkCodec& codec() noexcept { return codec_; }
  [[nodiscard]] const Transport& transport() const noexcept { return *transport_; }
  /// Attitudes that have come since the last call.
  std::vector<AttitudeSample> take_attitudes();
  /// Sentences for people since the last call: other systems heard, texts of the autopilot.
  std::vector<std::string> take_notes();

  [[nodiscard]] std::uint64_t received() const noexcept { return received_; }
  [[nodiscard]] std::uint64_t bad_frames() const noexcept { return codec_.bad_frames(); }

 private:
  void take(const Received& frame, double now_s);
  void request_streams(double now_s);
  void note(std::string text);

  std::unique_ptr<Transport> transport_;
  LinkOptions options_;
  MavlinkCodec codec_;
  ParameterCheck parameters_;
  VehicleState vehicle_;
  std::vector<AttitudeSample> attitudes_;
  SenderClock attitude_clock_;
  std::deque<double> rc_times_s_;
  std::deque<double> heartbeat_times_s_;
  std::vector<std::string> notes_;
  std::optional<double> sent_heartbeat_s_;
  std::optional<double> asked_streams_s_;
  std::array<bool, 256> foreign_{};
  std::uint64_t received_ = 0;
};

}  // namespace ajna::flight
