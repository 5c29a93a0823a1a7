// SPDX-License-Identifier: MIT
#include <algorithm>
#include <cmath>
#include <utility>

#include "ajna/geometry/camera.hpp"
#include "ajna/skills/skill_parts.hpp"

namespace ajna::skills {
namespace {

tasks::NavigateOptions pipeline_options(const SkillOptions& options) {
  tasks::NavigateOptions navigate = options.navigate;
  navigate.horizontal_fov_rad = options.horizontal_fov_rad;
  return navigate;
}

/// Fly to the goal through what is free. Pairs span baseline_s, so that what is near has moved by some pixels, and the
/// turning between them is taken out: what is left grows with inverse depth. The height is held by other sensors: of
/// the directions only the horizontal part is followed.
class NavigateSkill final : public Skill {
 public:
  NavigateSkill(const SkillOptions& options, Signal signal)
      : options_(options),
        signal_(std::move(signal)),
        max_age_s_(std::max(options.max_interval_s, options.baseline_s)),
        memory_(max_age_s_),
        pipeline_(pipeline_options(options)),
        policy_(options.navigate_policy) {}

  void begin() override {
    pipeline_.reset();
    policy_.reset();
    goal_yaw_rad_.reset();
    first_ = true;
  }

  void remember(const SkillInput& input) override { memory_.add(snapshot_of(input)); }

  SkillOutput plan(const SkillInput& input) override {
    Snapshot now = snapshot_of(input);
    SkillOutput output;
    try {
      output = decide(now, input);
    } catch (...) {  // whatever it is: later frames are compared with this one, and the caller is told
      memory_.add(std::move(now));
      throw;
    }
    memory_.add(std::move(now));
    return output;
  }

 private:
  SkillOutput decide(const Snapshot& now, const SkillInput& input) {
    SkillOutput output;
    const Attitude attitude = input.attitude.value_or(Attitude{});
    const Eigen::Vector3d goal = levelled(goal_of(input), input.too_high_m);
    const Snapshot* before = memory_.find(now.captured_s, options_.baseline_s, max_age_s_);
    const bool first = std::exchange(first_, false);
    if (before == nullptr || !same_size(now, *before)) {
      output.status = "first_frame";
      // Take off towards the goal: without motion there is no map. But once only: a camera whose frames never make
      // pairs must not be flown by.
      output.valid = first;
      if (first) {
        output.command = policy_.update(control::Guidance{goal, goal, 0.0}, now.captured_s, input.velocity_m_s);
      }
      return output;
    }
    const SignalMap seen = signal_(now, *before, CommonMotion::kRotation);
    output.flow = seen.flow;
    const auto result = pipeline_.step(seen.map, now.captured_s, camera_from_heading(attitude, goal));
    output.status = tasks::to_string(result.status);
    output.mask = result.steps.mask;
    std::optional<control::Guidance> guidance;
    if (result.status == tasks::NavigateStatus::kOk) {
      const auto free = levelled(heading_from_camera(attitude, result.free_direction), input.too_high_m);
      guidance = control::Guidance{goal, free, result.weight};
      const auto camera =
          geometry::Camera::from_horizontal_fov(seen.map.cols, seen.map.rows, options_.horizontal_fov_rad);
      output.point_px =
          camera.project(attitude.heading_from_camera.transpose() * control::desired_direction(*guidance));
    }
    if (result.status == tasks::NavigateStatus::kBlocked) {
      policy_.reset();  // stop now, not when the last answer has run out
    }
    output.command = policy_.update(guidance, now.captured_s, input.velocity_m_s);
    return output;
  }

  /// The way to the goal in the heading frame: as given, or a fixed bearing.
  Eigen::Vector3d goal_of(const SkillInput& input) {
    if (input.goal) {
      return *input.goal;
    }
    // Without a heading the goal stays where it was seen from: ahead, turned by the bearing.
    double angle = options_.goal_bearing_rad;
    if (input.attitude) {
      if (!goal_yaw_rad_) {
        goal_yaw_rad_ = input.attitude->yaw_rad + options_.goal_bearing_rad;
      }
      angle = *goal_yaw_rad_ - input.attitude->yaw_rad;
    }
    return {std::cos(angle), std::sin(angle), 0.0};
  }

  /// A direction without its vertical part, which instead leads back to the height to be held.
  [[nodiscard]] Eigen::Vector3d levelled(const Eigen::Vector3d& direction, double too_high_m) const {
    Eigen::Vector3d level(direction.x(), direction.y(), 0.0);
    level /= std::max(level.norm(), 1e-9);
    level.z() = std::clamp(options_.height_gain * too_high_m, -options_.largest_slope, options_.largest_slope);
    return level;
  }

  SkillOptions options_;
  Signal signal_;
  double max_age_s_;
  Memory memory_;
  tasks::NavigatePipeline pipeline_;
  control::NavigatePolicy policy_;
  std::optional<double> goal_yaw_rad_;
  bool first_ = true;
};

}  // namespace

std::unique_ptr<Skill> make_navigate_skill(const SkillOptions& options, Signal signal) {
  return std::make_unique<NavigateSkill>(options, std::move(signal));
}

}  // namespace ajna::skills
