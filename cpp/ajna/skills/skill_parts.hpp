// SPDX-License-Identifier: MIT
#pragma once

#include <deque>
#include <memory>
#include <optional>
#include <utility>

#include "ajna/skills/skill.hpp"

// What the skills share; private to this library.

namespace ajna::skills {

/// A copy of the frame and of what is known with it.
Snapshot snapshot_of(const SkillInput& input);

/// Of an RGB image that lives longer.
inline ImageView view_of(const cv::Mat& image) {
  return {image.data, image.cols, image.rows, 3, static_cast<std::ptrdiff_t>(image.step[0])};
}

/// Whether two frames can be a pair.
inline bool same_size(const Snapshot& a, const Snapshot& b) {
  return a.image.width() == b.image.width() && a.image.height() == b.image.height();
}

/// The frames of the last moments, in order.
class Memory {
 public:
  /// `keep_s`: how old a frame may become.
  explicit Memory(double keep_s) : keep_s_(keep_s) {}
  /// Frames that are not later than the last one are ignored.
  void add(Snapshot snapshot);
  /// The frame whose age at `now_s` is nearest to `age_s`; none that is older than `max_age_s`, or not older than now.
  [[nodiscard]] const Snapshot* find(double now_s, double age_s, double max_age_s) const;

 private:
  double keep_s_;
  std::deque<Snapshot> frames_;
};

/// What `decide` makes of a frame. Whatever it throws, the frame is remembered, so that later ones have a pair.
template <typename Decide>
SkillOutput remembering(Memory& memory, Snapshot now, Decide decide) {
  SkillOutput output;
  try {
    output = decide(now);
  } catch (...) {  // passed on to the caller as it is
    memory.add(std::move(now));
    throw;
  }
  memory.add(std::move(now));
  return output;
}

/// Heading frame to the axes that the pipelines call body: those of the camera (forward, right, down).
Eigen::Vector3d camera_from_heading(const Attitude& attitude, const Eigen::Vector3d& direction);
Eigen::Vector3d heading_from_camera(const Attitude& attitude, const Eigen::Vector3d& direction);

std::unique_ptr<Skill> make_dodge_skill(const SkillOptions& options, Signal signal);
std::unique_ptr<Skill> make_navigate_skill(const SkillOptions& options, Signal signal);
std::unique_ptr<Skill> make_gap_skill(const SkillOptions& options, Signal signal);

}  // namespace ajna::skills
