// SPDX-License-Identifier: MIT
#include "ajna/flight/control_loop.hpp"

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include "ajna/flight/emergency.hpp"
#include "ajna/flight/json_line.hpp"

namespace ajna::flight {
namespace {

constexpr double kLogEvery_s = 0.1;
/// So many writes in a row must fail before the link counts as broken: one full buffer is none.
constexpr int kFailedWrites = 3;
/// Oldest SYS_STATUS that still tells of the receiver; five a second are asked for.
constexpr double kStatusAge_s = 1.0;
constexpr double kStatusAgeDryRun_s = 5.0;
constexpr int kSeverityInfo = 6;
constexpr int kSeverityWarning = 4;

bool is_finite(const control::Command& command) {
  return command.velocity_m_s.allFinite() && command.acceleration_m_s2.allFinite() &&
         std::isfinite(command.yaw_rate_rad_s);
}

/// A listener cannot ask for faster streams: it takes those that there are.
SafetyOptions safety_options(const LoopOptions& options) {
  SafetyOptions safety = options.safety;
  if (options.dry_run) {
    safety.heartbeat_timeout_s = std::max(safety.heartbeat_timeout_s, 2.5);
    safety.rc_timeout_s = std::max(safety.rc_timeout_s, 1.0);
  }
  return safety;
}

std::vector<double> list_of(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }

}  // namespace

ControlLoop::ControlLoop(const LoopOptions& options, Link& link, CommandOutput& output, Blackboard& board,
                         FlightLog* log, Say say)
    : options_(options),
      link_(link),
      output_(output),
      board_(board),
      log_(log),
      say_(std::move(say)),
      safety_(safety_options(options)) {}

bool ControlLoop::done() const noexcept { return board_.stop.load() && safety_.at_rest(); }

std::uint32_t ControlLoop::boot_ms(double now_s) const {
  return static_cast<std::uint32_t>(std::max(0.0, now_s - began_s_.value_or(now_s)) * 1e3);
}

SafetyInputs ControlLoop::inputs(double now_s, const Perceived& perceived) const {
  const VehicleState& vehicle = link_.vehicle();
  SafetyInputs in;
  in.now_s = now_s;
  in.stop_requested = board_.stop.load();
  in.internal_error = board_.internal_error.load();
  in.link_open = options_.dry_run || (link_.transport().is_open() && !release_failed_);
  in.output_ok = options_.dry_run || (link_.transport().is_open() && failed_writes_ < kFailedWrites);
  in.heartbeat_s = vehicle.heartbeat_s;
  in.right_vehicle = vehicle.heartbeat.is_ardupilot_copter;
  in.autopilot_failsafe = vehicle.heartbeat.failsafe;
  in.rc_s = vehicle.rc_s;
  // Known only from SYS_STATUS; an autopilot that does not count its receiver as enabled has none that it uses.
  const double status_age_s = options_.dry_run ? kStatusAgeDryRun_s : kStatusAge_s;
  in.receiver_healthy = vehicle.sys_status_s && now_s - *vehicle.sys_status_s <= status_age_s &&
                        vehicle.sys_status.rc_receiver_enabled && vehicle.sys_status.rc_receiver_healthy;
  in.armed = vehicle.heartbeat.armed;
  in.mode_allowed = std::find(options_.allowed_modes.begin(), options_.allowed_modes.end(),
                              vehicle.heartbeat.custom_mode) != options_.allowed_modes.end();
  in.switch_us = vehicle.channel_us(options_.switch_channel);
  in.parameters = options_.dry_run ? ParameterState::kOk : link_.parameters().state();
  in.override_followed = options_.dry_run || safety_.state() != SafetyState::kActive || echo_.followed();
  in.model_tested = true;  // FlightLoop is only given a network that has passed
  in.frame_s = perceived.frame_s;
  in.network_ok = perceived.network_ok;
  in.command_frame_s = perceived.command_frame_s;
  in.command_finite = command_valid_ && is_finite(perceived.command);
  return in;
}

SafetyDecision ControlLoop::tick(double now_s) {
  if (!began_s_) {
    began_s_ = now_s;
  }
  link_.service(now_s, safety_.state() == SafetyState::kActive);
  board_.attitudes.add(link_.take_attitudes());
  board_.vehicle_moved(link_.vehicle().motion(now_s));
  const Perceived perceived = board_.perceived();
  if (perceived.commands != latency_command_ && perceived.command_frame_s) {
    latency_command_ = perceived.commands;
    latency_.add(now_s - *perceived.command_frame_s);
  }
  if (link_.vehicle().rc_s != rc_seen_s_) {
    rc_seen_s_ = link_.vehicle().rc_s;
    echo_.received(now_s, link_.vehicle().rc);
  }

  const SafetyDecision decision = safety_.step(inputs(now_s, perceived));
  if (decision.activated) {
    output_.reset();
    echo_.reset();
    sent_s_.reset();
    failed_writes_ = 0;
    old_command_ = perceived.commands;
    ++board_.activations;
  }
  if (decision.send_command) {
    send_command(now_s, perceived);
  } else if (decision.send_release) {
    send_release(now_s);
  }
  if (decision.state == SafetyState::kStandby || !link_.transport().is_open()) {
    EmergencyRelease::disarm();  // a closed link's descriptor may be another file's by now
  }
  if (decision.state == SafetyState::kStandby) {
    // What failed is tried anew: heartbeats tell whether the link takes data again.
    failed_writes_ = 0;
    release_failed_ = false;
    command_valid_ = true;
  }
  report(now_s, decision);
  log_state(now_s, decision, perceived);
  return decision;
}

void ControlLoop::send_command(double now_s, const Perceived& perceived) {
  const bool due = !sent_s_ || perceived.commands != last_command_ || now_s - *sent_s_ >= options_.command_every_s;
  if (!due) {
    return;
  }
  const VehicleMotion motion = link_.vehicle().motion(now_s);
  // What was made before the activation was not made for it: it begins at hold.
  const control::Command command = perceived.commands == old_command_ ? control::Command::hold() : perceived.command;
  const double dt_s = sent_s_ ? now_s - *sent_s_ : 0.0;
  const auto frame = output_.command(link_.codec(), command, dt_s, motion, boot_ms(now_s));
  if (!frame) {
    command_valid_ = false;  // the next tick releases
    return;
  }
  sent_s_ = now_s;
  last_command_ = perceived.commands;
  if (options_.dry_run) {
    return;
  }
  // First the way back, then the way out.
  const Bytes release = output_.release(link_.codec(), motion, boot_ms(now_s));
  EmergencyRelease::arm(link_.transport().descriptor(), release.data(), release.size());
  if (!link_.send(*frame)) {
    ++failed_writes_;
    return;
  }
  failed_writes_ = 0;
  ++commands_sent_;
  if (const auto pulses = output_.last_pulses()) {
    echo_.sent(now_s, *pulses);
  }
}

void ControlLoop::send_release(double now_s) {
  if (options_.dry_run) {
    return;
  }
  const Bytes frame = output_.release(link_.codec(), link_.vehicle().motion(now_s), boot_ms(now_s));
  release_failed_ = !link_.send(frame);
  if (!release_failed_) {
    ++releases_sent_;
  }
}

void ControlLoop::report(double now_s, const SafetyDecision& decision) {
  const auto event = [&](Level level, const std::string& text) {
    say_(level, text);
    if (log_ != nullptr) {
      log_->write(JsonLine().add("type", "event").add("time_s", now_s - *began_s_).add("text", text).str());
    }
  };
  for (const auto& note : link_.take_notes()) {
    event(Level::kInfo, note);
  }
  if (decision.activated) {
    event(Level::kWarning, options_.dry_run ? "active (dry run: nothing is sent)" : "active: commands are being sent");
    link_.send(link_.codec().status_text(kSeverityInfo, "ajna: active"));
  }
  if (decision.released) {
    const std::string name = to_string(decision.release_reason);
    event(Level::kWarning, "released (" + name + "): " + explain(decision.release_reason));
    link_.send(link_.codec().status_text(kSeverityWarning, "ajna: released, " + name));
  }
  std::string objection;
  if (link_.parameters().state() == ParameterState::kRefused && !options_.dry_run) {
    for (const auto& reason : link_.parameters().reasons()) {
      objection += (objection.empty() ? "" : "; ") + reason;
    }
  }
  if (objection != objection_) {
    objection_ = objection;
    if (!objection.empty()) {
      event(Level::kError, objection);
    }
  }
  if (decision.state != SafetyState::kActive && decision.fault != Fault::kNone && decision.fault != reported_) {
    reported_ = decision.fault;
    const std::string problem = decision.fault == Fault::kOutput ? " (" + link_.transport().problem() + ")" : "";
    event(Level::kInfo,
          "waiting (" + std::string(to_string(decision.fault)) + "): " + explain(decision.fault) + problem);
  } else if (decision.state == SafetyState::kActive) {
    reported_.reset();
  }
}

void ControlLoop::log_state(double now_s, const SafetyDecision& decision, const Perceived& perceived) {
  const bool changed = decision.activated || decision.released;
  if (log_ == nullptr || (!changed && logged_s_ && now_s - *logged_s_ < kLogEvery_s)) {
    return;
  }
  logged_s_ = now_s;
  const VehicleState& vehicle = link_.vehicle();
  const auto age = [&](const std::optional<double>& then_s) { return then_s ? now_s - *then_s : NAN; };
  JsonLine line;
  line.add("type", "state")
      .add("time_s", now_s - *began_s_)
      .add("state", to_string(decision.state))
      .add("fault", to_string(decision.fault))
      .add("armed", vehicle.heartbeat.armed)
      .add("mode", copter_mode_name(vehicle.heartbeat.custom_mode))
      .add("switch_us", vehicle.channel_us(options_.switch_channel).value_or(0))
      .add("heartbeat_age_s", age(vehicle.heartbeat_s))
      .add("rc_age_s", age(vehicle.rc_s))
      .add("frame_age_s", age(perceived.frame_s))
      .add("command_age_s", age(perceived.command_frame_s))
      .add("command", control::to_string(perceived.command.mode))
      .add("velocity_m_s", list_of(perceived.command.velocity_m_s))
      .add("yaw_rate_rad_s", perceived.command.yaw_rate_rad_s)
      .add("euler_rad", std::vector<double>(vehicle.attitude.euler_rad.begin(), vehicle.attitude.euler_rad.end()))
      .add("commands_sent", commands_sent_)
      .add("releases_sent", releases_sent_)
      .add("received", link_.received())
      .add("bad_frames", link_.bad_frames());
  if (const auto pulses = output_.last_pulses(); pulses && decision.state == SafetyState::kActive) {
    line.add("pulses_us", std::vector<double>(pulses->begin(), pulses->end()));
  }
  log_->write(line.str());
}

}  // namespace ajna::flight
