// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <variant>

#include "ajna/control/command.hpp"
#include "ajna/control/policies.hpp"
#include "ajna/skills/signal.hpp"
#include "ajna/tasks/closer_look.hpp"
#include "ajna/tasks/corridor.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/gap.hpp"
#include "ajna/tasks/horizon.hpp"
#include "ajna/tasks/navigate.hpp"

// Frames in, commands out: signal, pipeline and policy of one task, flown alike by the flight program and the
// simulation.

namespace ajna::skills {

enum class Task : std::uint8_t { kDodge, kNavigate, kGap };
const char* to_string(Task task) noexcept;

/// Limits of SkillOptions::planning_rate_hz and latency_s.
inline constexpr double kSlowestPlanning_hz = 2.0;
inline constexpr double kFastestPlanning_hz = 200.0;
inline constexpr double kLongestLatency_s = 1.0;

struct SkillOptions {
  Task task = Task::kDodge;
  double horizontal_fov_rad = 1.2;
  double planning_rate_hz = 30.0;  ///< frames that are planned on: limits in frames follow from it
  double latency_s = 0.0;          ///< navigate: from a frame to when its command acts
  double max_interval_s = 0.2;     ///< between the frames of a pair; frames further apart are not compared
  double goal_bearing_rad = 0.0;   ///< navigate, where no goal is given: to the right of the heading at the beginning

  tasks::DodgeOptions dodge;
  double dodge_pair_s = 0.167;  ///< between the frames of a pair, as near as the camera's rate allows; 0: neighbours
  control::DodgePolicyOptions dodge_policy;
  tasks::CloserLookOptions closer_look;  ///< dodge: Skill::outline

  tasks::HorizonOptions horizon;      ///< navigate, where attitude and velocity are known ...
  tasks::OccupancyOptions occupancy;  ///< ... and
  tasks::CorridorOptions corridor;    ///< ... and
  tasks::NavigateOptions navigate;    ///< where they are not
  control::NavigatePolicyOptions navigate_policy;
  double max_turn_rad_s = 2.5;       ///< frames of a faster turn are blurred: the last answer stands for lookahead_s
  double baseline_s = 0.2;           ///< between the frames of a pair: what is near has then moved by some pixels ...
  double baseline_m = 0.4;           ///< ... longer while the vehicle moves less than this in it ...
  double longest_baseline_s = 0.4;   ///< ... but no longer: after that a turn has left little in common
  double baseline_share = 0.3;       ///< shorter where the way is a larger share of the distance to what is nearest in
                                     ///< the fan: what has moved further is saturated ...
  double shortest_baseline_s = 0.1;  ///< ... but no shorter
  double height_gain = 0.4;  ///< downward part of the direction per metre too high; only level directions are followed
  double largest_slope = 0.3;  ///< of that part

  tasks::GapOptions gap;  ///< min_pairs and max_pairs follow from first_look_s and last_look_s ...
  int fewest_pairs = 3;   ///< ... but for a slow camera
  control::GapPolicyOptions gap_policy;
  control::ExploreOptions explore;  ///< as long as the pipeline wants it: duration_s is not used
  double settle_s = 0.3;            ///< of hovering before the exploratory motion
  double rest_m_s = 0.15;           ///< what counts as at rest ...
  double rest_rad = 0.05;           ///< ... and as level
  double first_look_s = 0.4;        ///< of exploring before the first look at the stacked maps
  double last_look_s = 0.8;         ///< without a gap for so long: explore anew, the other way
  double slew_m_s2 = 2.0;           ///< change of the velocity asked for: what is harder tilts the camera, and blurs
};
/// Throws Error(kInvalidArgument) that names the first option out of range, those of pipeline and policy included.
void validate(const SkillOptions& options);

/// A frame, and what the vehicle's other sensors say at that time.
struct SkillInput {
  ImageView frame;  ///< RGB; may be empty where neither signal nor task needs a picture
  double captured_s = 0.0;
  /// Nothing, or one that is no number: the camera is taken to be level, and turning is not taken out.
  std::optional<Attitude> attitude;
  std::optional<Eigen::Vector3d> velocity_m_s;  ///< levelled heading frame (forward, right, down)
  std::optional<Eigen::Vector3d> goal;          ///< navigate: the way to it, heading frame, any positive length
  double too_high_m = 0.0;                      ///< navigate: above the height to be held
  std::shared_ptr<const void> tag;              ///< see Snapshot
};

/// What a skill makes of a frame.
struct SkillOutput {
  control::Command command;
  bool valid = true;                        ///< false: this frame says nothing, and `command` is none
  std::string status;                       ///< of the pipeline, or "first_frame", "settling"
  bool decided = false;                     ///< the frame on which a detection is first acted on
  cv::Mat mask;                             ///< CV_8U, 0 or 255, in this frame: obstacle, what is near, gap; or empty
  std::optional<Eigen::Vector2d> point_px;  ///< in this frame: the obstacle, the safe direction, the safe point
  std::optional<FlowSummary> flow;          ///< where the network ran

  /// For pictures: the map that was looked at, CV_32F on the grid of its pair's first frame (this one, but for gap: the
  /// one that the exploration began with); empty where there was no pair.
  cv::Mat map;
  /// What the pipeline said, where one was asked; of gap in the frame without roll and pitch.
  std::variant<std::monostate, tasks::DodgeResult, tasks::NavigateResult, tasks::GapResult> details;
};

/// One task, with the frames it remembers. Used by one thread. Frames come in order.
class Skill {
 public:
  virtual ~Skill() = default;
  Skill() = default;
  Skill(const Skill&) = delete;
  Skill& operator=(const Skill&) = delete;

  /// Plan on a frame. Throws what the signal throws; the frame is remembered all the same, nothing else is changed.
  virtual SkillOutput plan(const SkillInput& input) = 0;
  /// What the last plan() found, outlined more sharply than its mask, by a closer look at enlarged pictures of its
  /// pair: CV_8U, 0 or 255, on the frame that was planned on. Empty where nothing was found, where the frames have no
  /// picture, where nothing stands out, and for tasks other than dodging. It asks the signal once more, for pictures of
  /// closer_look's size, so it is no part of plan(): call it when the command is on its way. Throws what the signal
  /// throws.
  virtual cv::Mat outline() { return {}; }
  /// Only remember a frame that there is no time to plan on: pairs can then be as short as the camera's interval.
  virtual void remember(const SkillInput& input) = 0;
  /// Begin anew with the next frame: runs at each activation.
  virtual void begin() = 0;
};

/// Throws Error(kInvalidArgument) for options out of range.
std::unique_ptr<Skill> make_skill(const SkillOptions& options, Signal signal);

}  // namespace ajna::skills
