// SPDX-License-Identifier: MIT
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

#include "ajna/skills/skill_parts.hpp"
#include "ajna/tasks/align.hpp"

namespace ajna::skills {
namespace {

tasks::DodgeOptions pipeline_options(const SkillOptions& options) {
  constexpr double kMissedPlans = 2.5;
  constexpr double kMissedDetections = 1.5;
  constexpr double kConfirmed_s = 0.066;  // three frames of a fast camera; fewer of a slow one are as far apart
  tasks::DodgeOptions dodge = options.dodge;
  dodge.horizontal_fov_rad = options.horizontal_fov_rad;
  dodge.max_gap_s = std::max(dodge.max_gap_s, kMissedPlans / options.planning_rate_hz);
  dodge.max_miss_s = std::max(dodge.max_miss_s, kMissedDetections / options.planning_rate_hz);
  dodge.confirm_frames = std::min(
      dodge.confirm_frames, std::max(2, 1 + static_cast<int>(std::ceil(kConfirmed_s * options.planning_rate_hz))));
  return dodge;
}

/// Hover until something comes. Pairs go from the new frame to an older one, so that the obstacle is found where it is
/// now.
class DodgeSkill final : public Skill {
 public:
  DodgeSkill(const SkillOptions& options, Signal signal)
      : signal_(std::move(signal)),
        pair_s_(options.dodge_pair_s),
        max_interval_s_(options.max_interval_s),
        horizontal_fov_rad_(options.horizontal_fov_rad),
        closer_look_(options.closer_look),
        memory_(options.max_interval_s),
        pipeline_(pipeline_options(options)),
        policy_(options.dodge_policy) {}

  void begin() override {
    pipeline_.reset();
    policy_.reset();
    planned_.reset();
    found_.reset();
    decided_ = false;
  }

  void remember(const SkillInput& input) override { memory_.add(snapshot_of(input)); }

  cv::Mat outline() override {
    if (!found_) {
      return {};
    }
    const tasks::CloserLook look = tasks::closer_look_at(found_->mask, closer_look_);
    const Snapshot first = closer(found_->now, found_->now.image.view(), look);
    Snapshot second;
    if (found_->now.attitude && found_->before.attitude) {
      const Eigen::Matrix3d turn = found_->now.attitude->turn_from(*found_->before.attitude);
      const auto still = tasks::derotate_frame(found_->before.image.view(), turn, horizontal_fov_rad_);
      second = closer(found_->before, view_of(still.image), look);
    } else {
      second = closer(found_->before, found_->before.image.view(), look);
    }
    return tasks::outline(signal_(first, second, CommonMotion::kNone).map, found_->mask, look, closer_look_);
  }

  SkillOutput plan(const SkillInput& input) override {
    return remembering(memory_, snapshot_of(input), [this](const Snapshot& now) { return decide(now); });
  }

 private:
  /// What the last plan() found something in.
  struct Found {
    Snapshot now;
    Snapshot before;
    cv::Mat mask;
  };

  static Snapshot closer(const Snapshot& frame, const ImageView& picture, const tasks::CloserLook& look) {
    Snapshot result;
    result.captured_s = frame.captured_s;
    result.tag = frame.tag;
    result.image = tasks::enlarge(picture, look);
    return result;
  }

  SkillOutput decide(const Snapshot& now) {
    SkillOutput output;
    found_.reset();
    const Snapshot* before = memory_.find(now.captured_s, pair_s_, max_interval_s_);
    if (before == nullptr || !same_size(now, *before)) {
      output.status = "first_frame";
      output.valid = false;
      return output;
    }
    const SignalMap seen = signal_(now, *before, CommonMotion::kRotation);
    output.flow = seen.flow;
    output.map = seen.map;
    output.details = pipeline_.step(seen.map, now.captured_s, turning(now));
    const auto& result = std::get<tasks::DodgeResult>(output.details);
    output.status = tasks::to_string(result.status);
    output.command = policy_.update(result.safe_direction, now.captured_s);
    output.decided = policy_.dodging() && !decided_;
    decided_ = decided_ || policy_.dodging();
    output.mask = result.mask;
    if (!result.mask.empty()) {
      const auto& center = result.track.back().center_px;
      output.point_px = Eigen::Vector2d(center.x, center.y);
      if (!now.image.empty()) {
        found_ = Found{now, *before, result.mask};
      }
    }
    return output;
  }

  /// Angular velocity, optical frame, since the last frame that was planned on.
  std::optional<Eigen::Vector3d> turning(const Snapshot& now) {
    const auto before =
        std::exchange(planned_, now.attitude ? std::optional(Planned{now.captured_s, *now.attitude}) : std::nullopt);
    if (!before || !now.attitude || now.captured_s <= before->time_s) {
      return std::nullopt;
    }
    const Eigen::AngleAxisd turn(before->attitude.turn_from(*now.attitude));
    return Eigen::Vector3d(turn.axis() * (turn.angle() / (now.captured_s - before->time_s)));
  }

  struct Planned {
    double time_s;
    Attitude attitude;
  };

  Signal signal_;
  double pair_s_;
  double max_interval_s_;
  double horizontal_fov_rad_;
  tasks::CloserLookOptions closer_look_;
  Memory memory_;
  tasks::DodgePipeline pipeline_;
  control::DodgePolicy policy_;
  std::optional<Planned> planned_;
  std::optional<Found> found_;
  bool decided_ = false;
};

}  // namespace

std::unique_ptr<Skill> make_dodge_skill(const SkillOptions& options, Signal signal) {
  return std::make_unique<DodgeSkill>(options, std::move(signal));
}

}  // namespace ajna::skills
