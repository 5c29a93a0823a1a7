// SPDX-License-Identifier: MIT
#include "ajna/skills/skill.hpp"

#include <cmath>
#include <cstring>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/base/range.hpp"
#include "ajna/skills/skill_parts.hpp"

namespace ajna::skills {
namespace {

constexpr std::size_t kMostFrames = 16;

Signal no_signal() {
  return [](const Snapshot&, const Snapshot&, CommonMotion) -> SignalMap { throw_runtime("no signal"); };
}

std::unique_ptr<Skill> made(const SkillOptions& options, Signal signal) {
  switch (options.task) {
    case Task::kDodge:
      return make_dodge_skill(options, std::move(signal));
    case Task::kNavigate:
      return make_navigate_skill(options, std::move(signal));
    case Task::kGap:
      break;
  }
  return make_gap_skill(options, std::move(signal));
}

}  // namespace

const char* to_string(Task task) noexcept {
  switch (task) {
    case Task::kDodge:
      return "dodge";
    case Task::kNavigate:
      return "navigate";
    case Task::kGap:
      return "gap";
  }
  return "unknown";
}

void validate(const SkillOptions& options) {
  require_between("task.horizontal_fov_rad", options.horizontal_fov_rad, 0.1, 3.0);
  require_between("task.planning_rate_hz", options.planning_rate_hz, kSlowestPlanning_hz, kFastestPlanning_hz);
  require_between("task.latency_s", options.latency_s, 0.0, kLongestLatency_s);
  require_between("task.max_interval_s", options.max_interval_s, 0.01, 1.0);
  require_between("task.goal_bearing_rad", options.goal_bearing_rad, -3.15, 3.15);
  require_between("task.dodge_pair_s", options.dodge_pair_s, 0.0, options.max_interval_s);
  require_between("task.baseline_s", options.baseline_s, 0.005, 0.5);
  require_between("task.baseline_m", options.baseline_m, 0.0, 10.0);
  require_between("task.longest_baseline_s", options.longest_baseline_s, options.baseline_s, 2.0);
  require_between("task.baseline_share", options.baseline_share, 0.05, 1000.0);
  require_between("task.shortest_baseline_s", options.shortest_baseline_s, 0.005, 2.0);
  require_between("task.max_turn_rad_s", options.max_turn_rad_s, 0.1, 100.0);
  require_between("task.height_gain", options.height_gain, 0.0, 10.0);
  require_between("task.largest_slope", options.largest_slope, 0.0, 1.0);
  require_between("task.settle_s", options.settle_s, 0.0, 10.0);
  require_between("task.rest_m_s", options.rest_m_s, 0.01, 2.0);
  require_between("task.rest_rad", options.rest_rad, 0.01, 0.5);
  require_between("task.fewest_pairs", options.fewest_pairs, 1, 100);
  require_between("task.first_look_s", options.first_look_s, 0.0, 5.0);
  require_between("task.last_look_s", options.last_look_s, options.first_look_s, 10.0);
  require_between("task.slew_m_s2", options.slew_m_s2, 0.1, 50.0);
  tasks::validate(options.closer_look);
  SkillOptions other = options;
  for (const Task task : {Task::kDodge, Task::kNavigate, Task::kGap}) {
    other.task = task;
    made(other, no_signal());  // pipelines and policies look at their own options
  }
}

namespace {

/// What other sensors say counts as not said where it is no number: one such frame must not spoil what is kept.
class SoundInput final : public Skill {
 public:
  explicit SoundInput(std::unique_ptr<Skill> skill) : skill_(std::move(skill)) {}
  SkillOutput plan(const SkillInput& input) override { return skill_->plan(sound(input)); }
  cv::Mat outline() override { return skill_->outline(); }
  void remember(const SkillInput& input) override { skill_->remember(sound(input)); }
  void begin() override { skill_->begin(); }

 private:
  static SkillInput sound(SkillInput input) {
    if (input.attitude &&
        !(input.attitude->heading_from_camera.allFinite() && std::isfinite(input.attitude->yaw_rad))) {
      input.attitude.reset();
    }
    if (input.velocity_m_s && !input.velocity_m_s->allFinite()) {
      input.velocity_m_s.reset();
    }
    return input;
  }

  std::unique_ptr<Skill> skill_;
};

}  // namespace

std::unique_ptr<Skill> make_skill(const SkillOptions& options, Signal signal) {
  if (!signal) {
    throw_invalid("a skill needs a signal: give network_signal(...), or a function of your own");
  }
  validate(options);
  return std::make_unique<SoundInput>(made(options, std::move(signal)));
}

Snapshot snapshot_of(const SkillInput& input) {
  Snapshot snapshot;
  snapshot.captured_s = input.captured_s;
  snapshot.attitude = input.attitude;
  snapshot.tag = input.tag;
  if (!input.frame.empty()) {
    if (input.frame.channels != 3) {
      throw_invalid("frame has " + std::to_string(input.frame.channels) + " channels: give an RGB image");
    }
    snapshot.image = Image(input.frame.width, input.frame.height);
    const auto row = static_cast<std::size_t>(input.frame.width) * 3;
    for (int y = 0; y < input.frame.height; ++y) {
      std::memcpy(snapshot.image.data() + static_cast<std::size_t>(y) * row,
                  input.frame.data + y * input.frame.row_stride, row);
    }
  }
  return snapshot;
}

void Memory::add(Snapshot snapshot) {
  if (!std::isfinite(snapshot.captured_s) || (!frames_.empty() && snapshot.captured_s <= frames_.back().captured_s)) {
    return;
  }
  // A frame of another size has no pair among those before it.
  if (!frames_.empty() && (snapshot.image.width() != frames_.back().image.width() ||
                           snapshot.image.height() != frames_.back().image.height())) {
    frames_.clear();
  }
  const double oldest_s = snapshot.captured_s - keep_s_;
  frames_.push_back(std::move(snapshot));
  while (frames_.size() > kMostFrames || frames_.front().captured_s < oldest_s) {
    frames_.pop_front();
  }
}

const Snapshot* Memory::find(double now_s, double age_s, double max_age_s) const {
  const Snapshot* best = nullptr;
  for (const Snapshot& frame : frames_) {
    const double age = now_s - frame.captured_s;
    if (age > 0.0 && age <= max_age_s + 1e-9 &&
        (best == nullptr || std::abs(age - age_s) < std::abs(now_s - best->captured_s - age_s))) {
      best = &frame;
    }
  }
  return best;
}

Eigen::Vector3d camera_from_heading(const Attitude& attitude, const Eigen::Vector3d& direction) {
  const Eigen::Vector3d seen = attitude.heading_from_camera.transpose() * direction;
  return {seen.z(), seen.x(), seen.y()};
}

Eigen::Vector3d heading_from_camera(const Attitude& attitude, const Eigen::Vector3d& direction) {
  return attitude.heading_from_camera * Eigen::Vector3d(direction.y(), direction.z(), direction.x());
}

}  // namespace ajna::skills
