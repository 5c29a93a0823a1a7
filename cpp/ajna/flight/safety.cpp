// SPDX-License-Identifier: MIT
#include "ajna/flight/safety.hpp"

#include <cmath>
#include <string>

#include "ajna/base/range.hpp"

namespace ajna::flight {
namespace {

/// Threads read the clock one after the other: what is further in the future than this is a broken time.
constexpr double kSkew_s = 0.02;

/// Whether something that happened at `then_s` is at most `timeout_s` old.
bool fresh(const std::optional<double>& then_s, double now_s, double timeout_s) {
  return then_s && std::isfinite(*then_s) && *then_s <= now_s + kSkew_s && now_s - *then_s <= timeout_s;
}

}  // namespace

const char* to_string(Fault fault) noexcept {
  switch (fault) {
    case Fault::kNone:
      return "none";
    case Fault::kStop:
      return "stop";
    case Fault::kInternal:
      return "internal";
    case Fault::kClock:
      return "clock";
    case Fault::kLoopLate:
      return "loop_late";
    case Fault::kOutput:
      return "output";
    case Fault::kLinkLost:
      return "link_lost";
    case Fault::kWrongVehicle:
      return "wrong_vehicle";
    case Fault::kAutopilotFailsafe:
      return "autopilot_failsafe";
    case Fault::kNoPilotInput:
      return "no_pilot_input";
    case Fault::kReceiverLost:
      return "receiver_lost";
    case Fault::kNotArmed:
      return "not_armed";
    case Fault::kModeNotAllowed:
      return "mode_not_allowed";
    case Fault::kSwitchOff:
      return "switch_off";
    case Fault::kParametersUnknown:
      return "parameters_unknown";
    case Fault::kParametersRefused:
      return "parameters_refused";
    case Fault::kOverrideIgnored:
      return "override_ignored";
    case Fault::kModelNotTested:
      return "model_not_tested";
    case Fault::kCameraStale:
      return "camera_stale";
    case Fault::kNetworkInvalid:
      return "network_invalid";
    case Fault::kNetworkStale:
      return "network_stale";
    case Fault::kCommandInvalid:
      return "command_invalid";
    case Fault::kSwitchNotCycled:
      return "switch_not_cycled";
  }
  return "unknown";
}

const char* explain(Fault fault) noexcept {
  switch (fault) {
    case Fault::kNone:
      return "all is well";
    case Fault::kStop:
      return "the program is ending";
    case Fault::kInternal:
      return "a part of the program failed: restart it, and read its log";
    case Fault::kClock:
      return "the monotonic clock went back: restart the computer";
    case Fault::kLoopLate:
      return "the control loop was held up: the computer is overloaded";
    case Fault::kOutput:
      return "the link takes no data: check the cable and the baud rate";
    case Fault::kLinkLost:
      return "no heartbeat of the autopilot: check the link, its baud rate and target_system";
    case Fault::kWrongVehicle:
      return "the autopilot is not ArduPilot's Copter: commands would mean something else to it";
    case Fault::kAutopilotFailsafe:
      return "the autopilot reports a failsafe: it and the pilot have the vehicle";
    case Fault::kNoPilotInput:
      return "no recent RC channels from the autopilot: check the link and the receiver";
    case Fault::kReceiverLost:
      return "the autopilot does not call its RC receiver healthy";
    case Fault::kNotArmed:
      return "the vehicle is not armed";
    case Fault::kModeNotAllowed:
      return "the flight mode is not one of safety.allowed_modes";
    case Fault::kSwitchOff:
      return "the pilot's switch is off";
    case Fault::kParametersUnknown:
      return "the autopilot has not told its parameters yet";
    case Fault::kParametersRefused:
      return "the autopilot's parameters do not allow safe commands";
    case Fault::kOverrideIgnored:
      return "the autopilot ignores our commands: compare mavlink.system_id with its MAV_GCS_SYSID (SYSID_MYGCS)";
    case Fault::kModelNotTested:
      return "no model has passed its self-test";
    case Fault::kCameraStale:
      return "no good frame from the camera: check its cable and its light";
    case Fault::kNetworkInvalid:
      return "the network failed or gave values that are not finite";
    case Fault::kNetworkStale:
      return "inference is too slow or stands still: smaller frames or more threads";
    case Fault::kCommandInvalid:
      return "the policy gave a command that is not finite";
    case Fault::kSwitchNotCycled:
      return "turn the pilot's switch off and on again";
  }
  return "unknown";
}

const char* to_string(SafetyState state) noexcept {
  switch (state) {
    case SafetyState::kStandby:
      return "standby";
    case SafetyState::kActive:
      return "active";
    case SafetyState::kReleasing:
      return "releasing";
  }
  return "unknown";
}

void validate(const SafetyOptions& options) {
  require_between("safety.heartbeat_timeout_s", options.heartbeat_timeout_s, 0.2, 10.0);
  require_between("safety.rc_timeout_s", options.rc_timeout_s, 0.05, 1.0);
  require_between("safety.camera_timeout_s", options.camera_timeout_s, 0.03, 1.0);
  require_between("safety.command_timeout_s", options.command_timeout_s, 0.03, 1.0);
  require_between("safety.max_tick_s", options.max_tick_s, 0.04, 0.5);
  require_between("safety.switch_hold_s", options.switch_hold_s, 0.0, 2.0);
  require_between("safety.release_duration_s", options.release_duration_s, 0.1, 5.0);
  require_between("safety.release_repeats", options.release_repeats, 3, 100);
  require_between("safety.switch_on_min_us", options.switch_on_min_us, 1600, 2000);
  require_between("safety.switch_off_max_us", options.switch_off_max_us, 900, 1400);
}

SafetyMachine::SafetyMachine(const SafetyOptions& options) : options_(options) { validate(options); }

Fault SafetyMachine::check_vehicle(const SafetyInputs& in) const noexcept {
  if (!fresh(in.heartbeat_s, in.now_s, options_.heartbeat_timeout_s)) {
    return Fault::kLinkLost;
  }
  if (!in.right_vehicle) {
    return Fault::kWrongVehicle;
  }
  if (in.autopilot_failsafe) {
    return Fault::kAutopilotFailsafe;
  }
  if (!fresh(in.rc_s, in.now_s, options_.rc_timeout_s) || !in.switch_us) {
    return Fault::kNoPilotInput;
  }
  if (!in.receiver_healthy) {
    return Fault::kReceiverLost;
  }
  if (!in.armed) {
    return Fault::kNotArmed;
  }
  if (!in.mode_allowed) {
    return Fault::kModeNotAllowed;
  }
  // The highest sensible pulse: receivers give implausible ones when they lose their transmitter.
  constexpr int kHighestPulse_us = 2200;
  if (*in.switch_us < options_.switch_on_min_us || *in.switch_us > kHighestPulse_us) {
    return Fault::kSwitchOff;
  }
  return Fault::kNone;
}

Fault SafetyMachine::check_perception(const SafetyInputs& in) const noexcept {
  if (in.parameters != ParameterState::kOk) {
    return in.parameters == ParameterState::kRefused ? Fault::kParametersRefused : Fault::kParametersUnknown;
  }
  if (!in.override_followed) {
    return Fault::kOverrideIgnored;
  }
  if (!in.model_tested) {
    return Fault::kModelNotTested;
  }
  if (!fresh(in.frame_s, in.now_s, options_.camera_timeout_s)) {
    return Fault::kCameraStale;
  }
  if (!in.network_ok) {
    return Fault::kNetworkInvalid;
  }
  if (!fresh(in.command_frame_s, in.now_s, options_.command_timeout_s)) {
    // Where the newest frame has been dealt with, it is the next frame that is missing.
    const bool kept_up = in.command_frame_s && *in.command_frame_s >= *in.frame_s;
    return kept_up ? Fault::kCameraStale : Fault::kNetworkStale;
  }
  return in.command_finite ? Fault::kNone : Fault::kCommandInvalid;
}

Fault SafetyMachine::check(const SafetyInputs& in) const noexcept {
  if (in.stop_requested) {
    return Fault::kStop;
  }
  if (in.internal_error) {
    return Fault::kInternal;
  }
  if (!std::isfinite(in.now_s) || (last_s_ && in.now_s < *last_s_)) {
    return Fault::kClock;
  }
  if (last_s_ && in.now_s - *last_s_ > options_.max_tick_s) {
    return Fault::kLoopLate;
  }
  if (!in.output_ok || !in.link_open) {
    return Fault::kOutput;
  }
  const Fault vehicle = check_vehicle(in);
  // "Off" is what a pilot does on purpose: what else is amiss is of more interest while nothing is sent.
  if (vehicle == Fault::kSwitchOff && state_ != SafetyState::kActive) {
    const Fault perception = check_perception(in);
    return perception == Fault::kNone ? vehicle : perception;
  }
  return vehicle == Fault::kNone ? check_perception(in) : vehicle;
}

void SafetyMachine::follow_switch(const SafetyInputs& in, Fault fault) noexcept {
  const bool known = fresh(in.rc_s, in.now_s, options_.rc_timeout_s) && in.switch_us && in.receiver_healthy;
  const bool on = known && *in.switch_us >= options_.switch_on_min_us;
  if (known && *in.switch_us <= options_.switch_off_max_us) {
    switch_was_off_ = true;
  }
  // Turned on too early, or unknown for a while: that is no request.
  if (!known || (on && fault != Fault::kNone)) {
    switch_was_off_ = false;
  }
  if (!on || !switch_was_off_) {
    on_since_s_.reset();
  } else if (!on_since_s_) {
    on_since_s_ = in.now_s;
  }
}

SafetyDecision SafetyMachine::step(const SafetyInputs& in) noexcept {
  const Fault fault = check(in);
  const bool clock_ok = fault != Fault::kClock && std::isfinite(in.now_s);
  if (clock_ok) {
    last_s_ = last_s_ && in.now_s < *last_s_ ? *last_s_ : in.now_s;
  }
  SafetyDecision decision;
  decision.fault = fault;
  if (state_ == SafetyState::kActive && fault != Fault::kNone) {
    state_ = SafetyState::kReleasing;
    release_reason_ = fault;
    fault_s_ = release_began_s_ = last_s_.value_or(0.0);
    releases_ = 0;
    switch_was_off_ = false;
    on_since_s_.reset();
    decision.released = true;
  }
  switch (state_) {
    case SafetyState::kStandby:
      follow_switch(in, fault);
      if (fault == Fault::kNone) {
        if (on_since_s_ && in.now_s - *on_since_s_ >= options_.switch_hold_s) {
          state_ = SafetyState::kActive;
          decision.activated = true;
        } else if (!on_since_s_) {
          decision.fault = Fault::kSwitchNotCycled;
        }
      }
      break;
    case SafetyState::kReleasing:
      decision.send_release = true;
      if (!in.link_open) {
        // None of them has gone out. An autopilot that is still overridden when the link is back must hear of it then;
        // only a program that is to end cannot wait for that.
        releases_ = 0;
        release_began_s_ = last_s_.value_or(0.0);
        if (in.stop_requested && clock_ok && in.now_s - fault_s_ >= options_.release_duration_s) {
          state_ = SafetyState::kStandby;
        }
        break;
      }
      ++releases_;
      if (releases_ >= options_.release_repeats && clock_ok &&
          in.now_s - release_began_s_ >= options_.release_duration_s) {
        state_ = SafetyState::kStandby;
      }
      break;
    case SafetyState::kActive:
      break;
  }
  decision.send_command = state_ == SafetyState::kActive && fault == Fault::kNone;
  decision.state = state_;
  decision.release_reason = release_reason_;
  return decision;
}

}  // namespace ajna::flight
