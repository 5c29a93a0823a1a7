// SPDX-License-Identifier: MIT
#include "ajna/skills/signal.hpp"

#include <cmath>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/skills/skill_parts.hpp"
#include "ajna/tasks/align.hpp"

namespace ajna::skills {
Eigen::Matrix3d Attitude::level() {
  Eigen::Matrix3d axes;
  axes << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  return axes;
}

Eigen::Matrix3d Attitude::world_from_camera() const {
  const double c = std::cos(yaw_rad);
  const double s = std::sin(yaw_rad);
  Eigen::Matrix3d turn;
  turn << c, -s, 0, s, c, 0, 0, 0, 1;
  return turn * heading_from_camera;
}

Eigen::Matrix3d Attitude::turn_from(const Attitude& other) const {
  return world_from_camera().transpose() * other.world_from_camera();
}

const char* to_string(CommonMotion motion) noexcept {
  switch (motion) {
    case CommonMotion::kNone:
      return "none";
    case CommonMotion::kRotation:
      return "rotation";
    case CommonMotion::kPlane:
      return "plane";
  }
  return "unknown";
}

Signal network_signal(InferFunction infer, double horizontal_fov_rad, tasks::ScalarKind scalar) {
  if (!(horizontal_fov_rad > 0.0 && horizontal_fov_rad < M_PI)) {
    throw_invalid("signal: give a horizontal_fov_rad between 0 and pi");
  }
  // One field for all frames: no allocation while flying.
  auto field = std::make_shared<FlowField>();
  return [=, infer = std::move(infer)](const Snapshot& first, const Snapshot& second, CommonMotion common) {
    const ImageView reference = first.image.view();
    tasks::Alignment aligned;
    if (common == CommonMotion::kPlane) {
      aligned = tasks::align_to(reference, second.image.view());
    } else if (common == CommonMotion::kRotation && first.attitude && second.attitude) {
      aligned =
          tasks::derotate_frame(second.image.view(), first.attitude->turn_from(*second.attitude), horizontal_fov_rad);
    }
    infer(reference, aligned.image.empty() ? second.image.view() : view_of(aligned.image), *field, second.captured_s);
    SignalMap result;
    result.flow = summarize(*field);
    result.map = tasks::scalar_map(*field, scalar);
    if (!aligned.image.empty()) {
      result.map = tasks::within(result.map, aligned.valid);
      result.valid = aligned.valid;
    }
    return result;
  };
}

}  // namespace ajna::skills
