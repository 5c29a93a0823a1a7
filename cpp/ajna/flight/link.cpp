// SPDX-License-Identifier: MIT
#include "ajna/flight/link.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace ajna::flight {
namespace {

constexpr double kHeartbeatEvery_s = 1.0;
constexpr double kAskStreamsEvery_s = 3.0;
constexpr double kMotionAge_s = 0.5;
constexpr double kSysStatusRate_hz = 5.0;
constexpr std::size_t kAttitudes = 256;
constexpr std::size_t kNotes = 32;
/// An autopilot that was silent for so long may have restarted with other parameters.
constexpr double kSilence_s = 5.0;

/// What a terminal cannot mistake for a command.
std::string printable(std::string text) {
  std::replace_if(
      text.begin(), text.end(), [](char c) { return c < ' ' || c > '~'; }, '?');
  return text;
}

}  // namespace

std::optional<int> VehicleState::channel_us(int channel) const {
  constexpr int kAbsent = 65535;
  if (!rc_s || channel < 1 || channel > kRcChannels || channel > rc.count) {
    return std::nullopt;
  }
  const int pulse = rc.pulse_us[static_cast<std::size_t>(channel - 1)];
  return pulse == kAbsent || pulse == 0 ? std::nullopt : std::optional<int>(pulse);
}

VehicleMotion VehicleState::motion(double now_s) const {
  VehicleMotion motion;
  if (attitude_s && now_s - *attitude_s <= kMotionAge_s) {
    const double yaw = attitude.euler_rad[2];
    motion.yaw_rad = yaw;
    if (velocity_s && now_s - *velocity_s <= kMotionAge_s) {
      const auto& ned = velocity.ned_m_s;
      motion.velocity_m_s = Eigen::Vector3d(std::cos(yaw) * ned[0] + std::sin(yaw) * ned[1],
                                            -std::sin(yaw) * ned[0] + std::cos(yaw) * ned[1], ned[2]);
    }
  }
  return motion;
}

Link::Link(std::unique_ptr<Transport> transport, const LinkOptions& options, OutputKind output,
           const std::optional<SigningKey>& signing)
    : transport_(std::move(transport)),
      options_(options),
      codec_(options.ids, signing),
      parameters_(output, options.ids.system_id, options.max_override_s) {}

void Link::note(std::string text) {
  if (notes_.size() < kNotes) {
    notes_.push_back(std::move(text));
  }
}

std::vector<std::string> Link::take_notes() { return std::exchange(notes_, {}); }

bool Link::send(const Bytes& frame) noexcept {
  return !options_.listen_only && transport_->write(frame.data(), frame.size());
}

void Link::take(const Received& frame, double now_s) {
  ++received_;
  const bool ours =
      frame.system_id == options_.ids.target_system && frame.component_id == options_.ids.target_component;
  if (!ours) {
    const auto* beat = std::get_if<HeartbeatMessage>(&frame.message);
    const auto index = static_cast<std::size_t>(frame.system_id);
    if (beat != nullptr && beat->is_ardupilot_copter && !foreign_[index]) {
      foreign_[index] = true;
      note("heard a copter of system id " + std::to_string(frame.system_id) + ", component " +
           std::to_string(frame.component_id) + ", which is not ours: target_system is " +
           std::to_string(options_.ids.target_system));
    }
    return;
  }
  if (const auto* beat = std::get_if<HeartbeatMessage>(&frame.message)) {
    if (vehicle_.heartbeat_s && now_s - *vehicle_.heartbeat_s > kSilence_s) {
      parameters_.reset();
      asked_streams_s_.reset();
    }
    vehicle_.heartbeat = *beat;
    vehicle_.heartbeat_s = now_s;
    heartbeat_times_s_.push_back(now_s);
  } else if (const auto* rc = std::get_if<RcChannelsMessage>(&frame.message)) {
    vehicle_.rc = *rc;
    vehicle_.rc_s = now_s;
    rc_times_s_.push_back(now_s);
  } else if (const auto* attitude = std::get_if<AttitudeMessage>(&frame.message)) {
    vehicle_.attitude = *attitude;
    vehicle_.attitude_s = now_s;
    if (attitudes_.size() < kAttitudes) {
      attitudes_.push_back({attitude_clock_.sent_s(attitude->boot_ms, now_s),
                            Eigen::Vector3d(attitude->euler_rad.data()),
                            Eigen::Vector3d(attitude->rates_rad_s.data())});
    }
  } else if (const auto* velocity = std::get_if<VelocityMessage>(&frame.message)) {
    vehicle_.velocity = *velocity;
    vehicle_.velocity_s = now_s;
  } else if (const auto* status = std::get_if<SysStatusMessage>(&frame.message)) {
    vehicle_.sys_status = *status;
    vehicle_.sys_status_s = now_s;
  } else if (const auto* parameter = std::get_if<ParameterMessage>(&frame.message)) {
    parameters_.received(parameter->name, parameter->value);
  } else if (const auto* text = std::get_if<StatusTextMessage>(&frame.message)) {
    note("autopilot: " + printable(text->text));
  }
}

void Link::request_streams(double now_s) {
  const auto slower_than = [now_s](std::deque<double>& times_s, double rate_hz) {
    while (!times_s.empty() && now_s - times_s.front() > 1.0) {
      times_s.pop_front();
    }
    return static_cast<double>(times_s.size()) < 0.7 * rate_hz;
  };
  const bool rc_slow = slower_than(rc_times_s_, options_.rc_rate_hz);
  const bool too_slow = slower_than(heartbeat_times_s_, options_.heartbeat_rate_hz) || rc_slow;
  const bool attitude_missing = !vehicle_.attitude_s || now_s - *vehicle_.attitude_s > kMotionAge_s;
  if (!vehicle_.heartbeat_s || !(too_slow || attitude_missing || !vehicle_.sys_status_s) ||
      (asked_streams_s_ && now_s - *asked_streams_s_ < kAskStreamsEvery_s)) {
    return;
  }
  asked_streams_s_ = now_s;
  send(codec_.request_stream(Stream::kHeartbeat, options_.heartbeat_rate_hz));
  send(codec_.request_stream(Stream::kRc, options_.rc_rate_hz));
  send(codec_.request_stream(Stream::kAttitude, options_.attitude_rate_hz));
  send(codec_.request_stream(Stream::kSysStatus, kSysStatusRate_hz));
  send(codec_.request_stream(Stream::kLocalPosition, options_.rc_rate_hz));
}

void Link::service(double now_s, bool active) {
  transport_->service(now_s);
  std::array<std::uint8_t, 2048> buffer{};
  // Bounded, so that a flood cannot hold up the loop: 64 KiB a call.
  for (int i = 0; i < 32; ++i) {
    const std::size_t count = transport_->read(buffer.data(), buffer.size());
    if (count == 0) {
      break;
    }
    for (const auto& frame : codec_.decode(buffer.data(), count)) {
      take(frame, now_s);
    }
  }
  if (options_.listen_only) {
    return;
  }
  if (!sent_heartbeat_s_ || now_s - *sent_heartbeat_s_ >= kHeartbeatEvery_s) {
    // On a steady beat, unless more than one was missed.
    sent_heartbeat_s_ = sent_heartbeat_s_ && now_s - *sent_heartbeat_s_ < 2.0 * kHeartbeatEvery_s
                            ? *sent_heartbeat_s_ + kHeartbeatEvery_s
                            : now_s;
    send(codec_.heartbeat(active));
  }
  request_streams(now_s);
  if (vehicle_.heartbeat_s) {
    for (const auto& name : parameters_.wanted(now_s)) {
      send(codec_.request_parameter(name));
    }
  }
}

std::vector<AttitudeSample> Link::take_attitudes() { return std::exchange(attitudes_, {}); }

}  // namespace ajna::flight
