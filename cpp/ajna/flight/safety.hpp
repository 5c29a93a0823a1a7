// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <limits>
#include <optional>

// Who may command the vehicle, decided anew at every tick: a state machine without input, output, threads or a clock of
// its own. All times are seconds of one monotonic clock. Whatever is unknown counts as a fault.

namespace ajna::flight {

/// Why no command goes out; in the order in which they are looked for.
enum class Fault : std::uint8_t {
  kNone,
  kStop,               ///< the program was asked to end
  kInternal,           ///< an exception in one of its threads
  kClock,              ///< the monotonic clock stood still or went back
  kLoopLate,           ///< the control loop itself slept
  kOutput,             ///< the last commands could not be written to the link
  kLinkLost,           ///< no heartbeat of the autopilot
  kWrongVehicle,       ///< not ArduPilot's Copter
  kAutopilotFailsafe,  ///< the autopilot reports a failsafe or a critical state
  kNoPilotInput,       ///< RC channels of the autopilot are missing or old
  kReceiverLost,       ///< the autopilot calls its RC receiver unhealthy
  kNotArmed,
  kModeNotAllowed,
  kSwitchOff,          ///< the pilot's switch is not on
  kParametersUnknown,  ///< the autopilot has not yet told its parameters
  kParametersRefused,  ///< it has, and they would make an override unsafe or void
  kOverrideIgnored,    ///< the RC channels do not follow our override
  kModelNotTested,     ///< no model that passed its self-test
  kCameraStale,        ///< no good frame for too long
  kNetworkInvalid,     ///< the network gave NaN or failed
  kNetworkStale,       ///< no command that is young enough: inference is too slow or stands still
  kCommandInvalid,     ///< the policy gave a command that is not finite
  kSwitchNotCycled,    ///< all is well, but the switch has been on since before: off and on again
};
constexpr int kFaultCount = static_cast<int>(Fault::kSwitchNotCycled) + 1;
/// A short name, for logs ("camera_stale").
const char* to_string(Fault fault) noexcept;
/// One sentence for people, with the remedy.
const char* explain(Fault fault) noexcept;

enum class ParameterState : std::uint8_t { kUnknown, kOk, kRefused };

struct SafetyOptions {
  double heartbeat_timeout_s = 0.5;  ///< they tell the mode and whether it is armed; the link asks for 10 a second
  double rc_timeout_s = 0.15;        ///< of the RC_CHANNELS stream; notices a dead link long before the heartbeat does
  double camera_timeout_s = 0.15;    ///< since the newest good frame was taken
  double command_timeout_s = 0.15;   ///< since the frame was taken that the newest command is made from
  double max_tick_s = 0.1;           ///< between two calls of step
  double switch_hold_s = 0.1;        ///< the switch must stay on for so long before commands begin
  double release_duration_s = 0.5;   ///< releases are repeated for so long ...
  int release_repeats = 5;           ///< ... and at least so often
  int switch_on_min_us = 1800;       ///< at or above: on
  int switch_off_max_us = 1200;      ///< at or below: off; between the two it counts as off, but not as turned off
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const SafetyOptions& options);

/// What is known at a tick. The defaults are the worst case.
struct SafetyInputs {
  double now_s = std::numeric_limits<double>::quiet_NaN();
  bool stop_requested = false;
  bool internal_error = false;
  bool link_open = false;  ///< there is something to write to, and the last release, if any, was taken
  bool output_ok = false;  ///< and what is written is taken

  std::optional<double> heartbeat_s;  ///< when the last one came
  bool right_vehicle = false;
  bool autopilot_failsafe = true;
  std::optional<double> rc_s;  ///< when the last RC channels came
  bool receiver_healthy = false;
  bool armed = false;
  bool mode_allowed = false;
  std::optional<int> switch_us;  ///< the pilot's switch channel; nothing where the receiver does not deliver it
  ParameterState parameters = ParameterState::kUnknown;
  bool override_followed = true;  ///< false once the RC channels were seen not to follow our override

  bool model_tested = false;
  std::optional<double> frame_s;          ///< when the newest good frame was taken
  bool network_ok = false;                ///< the last inference succeeded
  std::optional<double> command_frame_s;  ///< when the frame was taken that the newest command is made from
  bool command_finite = false;
};

enum class SafetyState : std::uint8_t {
  kStandby,    ///< nothing is sent
  kActive,     ///< commands are sent
  kReleasing,  ///< the release is being repeated
};
const char* to_string(SafetyState state) noexcept;

/// What to do at this tick; never both.
struct SafetyDecision {
  SafetyState state = SafetyState::kStandby;
  bool send_command = false;
  bool send_release = false;
  bool activated = false;               ///< this tick is the first of an activation
  bool released = false;                ///< this tick is the first of a release
  Fault fault = Fault::kNone;           ///< why no command is sent now
  Fault release_reason = Fault::kNone;  ///< why the last release came about
};

/// Commands begin only on the pilot's switch going from off to on while all else is well (and staying there for
/// switch_hold_s); they end with the first tick at which anything is not, and then the switch must be turned off and on
/// again. A switch that is turned on while anything is amiss, or before the vehicle is armed, does not count.
class SafetyMachine {
 public:
  explicit SafetyMachine(const SafetyOptions& options = {});
  SafetyDecision step(const SafetyInputs& inputs) noexcept;

  [[nodiscard]] SafetyState state() const noexcept { return state_; }
  /// Nothing is being sent and nothing remains to be released: the program may end.
  [[nodiscard]] bool at_rest() const noexcept { return state_ == SafetyState::kStandby; }

 private:
  [[nodiscard]] Fault check(const SafetyInputs& inputs) const noexcept;
  [[nodiscard]] Fault check_vehicle(const SafetyInputs& inputs) const noexcept;
  [[nodiscard]] Fault check_perception(const SafetyInputs& inputs) const noexcept;
  void follow_switch(const SafetyInputs& inputs, Fault fault) noexcept;

  SafetyOptions options_;
  SafetyState state_ = SafetyState::kStandby;
  Fault release_reason_ = Fault::kNone;
  std::optional<double> last_s_;
  bool switch_was_off_ = false;
  std::optional<double> on_since_s_;
  double fault_s_ = 0.0;          ///< when commands ended
  double release_began_s_ = 0.0;  ///< the first release that has gone out since
  int releases_ = 0;
};

}  // namespace ajna::flight
