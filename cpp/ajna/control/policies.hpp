// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <deque>
#include <optional>

#include "ajna/control/command.hpp"
#include "ajna/control/pid.hpp"

// From what a perception pipeline says to a Command. Policies know nothing of maps or images: directions come as unit
// vectors in the body frame (forward, right, down) or as normalised image coordinates, and every policy has an answer
// to "nothing": it holds. Times are those of the frames, in seconds; a time that does not advance repeats the last
// command.

namespace ajna::control {

// --- Dodge: best effort ----------------------------------------------------------------------------------------------

struct DodgePolicyOptions {
  double speed_m_s = 3.0;       ///< sideways, at once: the obstacle is a fraction of a second away
  double burst_m_s2 = 15.0;     ///< acceleration asked for until that speed is due; 0: none, as gently as a velocity is
                                ///< followed. What a vehicle may tilt is its output's to limit
  double hold_s = 0.5;          ///< how long a dodge lasts after its last confirmation ...
  double longest_s = 0.6;       ///< ... but no longer than this: a camera that moves sees everything come
  double settle_s = 0.5;        ///< and none begins so soon after another, while the vehicle comes to rest
  double max_down_m_s = 1.0;    ///< downward part of a dodge, so that the floor does not replace the obstacle
  double max_turn_rad = 0.785;  ///< a new safe direction further off than this from the one under way is not followed
};

/// Moves in the safe direction of the image plane and keeps at it: turning back halfway is what gets hit.
class DodgePolicy {
 public:
  explicit DodgePolicy(const DodgePolicyOptions& options = {});
  /// safe_direction: in the image plane (x right, y down), of any positive length; nothing where there is no obstacle.
  Command update(const std::optional<Eigen::Vector2d>& safe_direction, double time_s);
  void reset() noexcept;
  [[nodiscard]] bool dodging() const noexcept { return until_s_.has_value(); }

 private:
  DodgePolicyOptions options_;
  Eigen::Vector2d direction_ = Eigen::Vector2d::Zero();
  std::optional<double> until_s_;
  double began_s_ = 0.0;
  std::optional<double> ended_s_;
  std::optional<double> last_s_;
  Command last_;
};

// --- Navigate: Eqs. 3 to 5 -------------------------------------------------------------------------------------------

struct NavigatePolicyOptions {
  double speed_m_s = 3.0;              ///< cruise speed
  double slow_down = 0.5;              ///< share of the speed that is given up at w = 1
  PidOptions direction;                ///< Eq. 5, m/s^2 per m/s that the direction error makes at cruise speed
  PidOptions yaw;                      ///< rad/s per rad between heading and desired direction
  double max_acceleration_m_s2 = 8.0;  ///< of the command
  double max_forward_m_s2 = 3.5;       ///< of it forwards: what is more tilts the camera until it sees but the ground
  double speed_up_s = 2.0;      ///< cruise speed is not reached sooner: what is near must be seen before it is hit
  double max_jerk_m_s3 = 25.0;  ///< of the command: what is harder turns the camera, and blurs
  double lookahead_s = 1.0;     ///< without an answer for this long the policy holds
  double weave = 0.125;   ///< sideways swing of a vehicle with known velocity, as a share of the cruise speed: what it
                          ///< flies straight at has no motion to be seen by; less below half that speed, none at rest
  double weave_hz = 0.7;  ///< of the swing
  double delay_s = 0.0;   ///< from a measurement to when its command acts, on average: what the commands before it do
                          ///< until then is counted on, or a late loop swings

  NavigatePolicyOptions();
};

/// What the local planner says of one frame.
struct Guidance {
  Eigen::Vector3d goal = Eigen::Vector3d::UnitX();  ///< v_g
  Eigen::Vector3d free = Eigen::Vector3d::UnitX();  ///< v_free
  double weight = 0.0;                              ///< w, 0 to 1
  std::optional<double> speed_m_s;                  ///< at most; nothing: cruise speed, less by slow_down w
};

/// (1 - w) v_g + w v_free, of unit length (Eq. 3); the goal where both cancel. Throws for a weight outside [0, 1] and
/// for directions that are not finite or zero.
Eigen::Vector3d desired_direction(const Guidance& guidance);

class NavigatePolicy {
 public:
  explicit NavigatePolicy(const NavigatePolicyOptions& options = {});
  /// guidance: nothing where the frame had no answer: the last one stands for lookahead_s, then the vehicle holds.
  /// velocity_m_s: measured, body frame; its ratio to the wanted speed is the current direction of Eq. 4, so that the
  /// error also holds the speed. Nothing: the vehicle flies where it looks.
  Command update(const std::optional<Guidance>& guidance, double time_s,
                 const std::optional<Eigen::Vector3d>& velocity_m_s = std::nullopt);
  void reset() noexcept;

  /// What commands that were given and have not acted yet will still change, until one of time_s acts.
  struct Pending {
    Eigen::Vector3d gained_m_s = Eigen::Vector3d::Zero();
    Eigen::Vector3d moved_m = Eigen::Vector3d::Zero();  ///< by what is gained, so beside the present velocity's way
    double turned_rad = 0.0;
  };
  [[nodiscard]] Pending pending(double time_s) const;
  [[nodiscard]] const NavigatePolicyOptions& options() const noexcept { return options_; }

 private:
  struct Given {
    double time_s;
    Eigen::Vector3d acceleration_m_s2;
    double yaw_rate_rad_s;
  };

  NavigatePolicyOptions options_;
  std::deque<Given> given_;  ///< of the last delay_s, and one before
  VectorPid direction_;
  Pid yaw_;
  Guidance guidance_;
  std::optional<double> answered_s_;
  std::optional<double> last_s_;
  double swung_s_ = 0.0;  ///< of the weave, since it began
  Command last_;
};

// --- Gap: exploratory manoeuvre, then visual servo -------------------------------------------------------------------

enum class ExploreKind {
  kDiagonal,      ///< a straight line to the right and up, for two-sided parallax
  kExcitedHover,  ///< a wobble about the spot, as a position loop of raised gain makes
};

const char* to_string(ExploreKind kind) noexcept;

struct ExploreOptions {
  ExploreKind kind = ExploreKind::kDiagonal;
  double speed_m_s = 0.5;
  double duration_s = 0.6;
  double frequency_hz = 1.1;  ///< excited hover: of the lateral axis; the vertical one is incommensurate with it
};

/// The manoeuvre at `elapsed_s` after its beginning; hold before it and after it.
Command explore(const ExploreOptions& options, double elapsed_s);

struct GapPolicyOptions {
  PidOptions servo;               ///< m/s per unit of normalised image offset, both axes; its limits bound the speed
  double forward_m_s = 1.0;       ///< once aligned
  double aligned = 0.12;          ///< normalised offset below which the vehicle goes forward
  double realign = 0.25;          ///< offset above which it stops going forward
  double lost_hold_s = 0.3;       ///< the last command stands for this long without a safe point
  double coast_m_s = 1.0;         ///< straight ahead once in the gap, where nothing is left to see of it
  double coast_duration_s = 1.0;  ///< and for how long

  GapPolicyOptions();
};

/// Steers the safe point to the image's centre, and through.
class GapPolicy {
 public:
  explicit GapPolicy(const GapPolicyOptions& options = {});
  /// offset: the safe point in normalised image coordinates; nothing where the gap is lost.
  /// through: the pipeline says that the gap surrounds the camera.
  Command update(const std::optional<Eigen::Vector2d>& offset, bool through, double time_s);
  void reset() noexcept;
  [[nodiscard]] bool finished() const noexcept { return finished_; }

 private:
  GapPolicyOptions options_;
  Pid right_, down_;
  bool advancing_ = false;
  bool finished_ = false;
  std::optional<double> through_since_s_;
  std::optional<double> seen_s_;
  std::optional<double> last_s_;
  Command last_;
};

}  // namespace ajna::control
