// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <functional>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>

#include "ajna/base/flow_field.hpp"
#include "ajna/base/image_view.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::skills {

/// Flow and uncertainty from frame 1 to frame 2 into a field. Throws Error where the network fails or gives values that
/// are not finite. The engine stands behind it in the programs, something else in tests.
using InferFunction =
    std::function<void(const ImageView& frame1, const ImageView& frame2, FlowField& field, double timestamp_s)>;

/// How the camera hung in the world when a frame was taken.
struct Attitude {
  /// Rotation from the camera's axes (right, down, forward) to the levelled heading frame (forward, right, down).
  Eigen::Matrix3d heading_from_camera = level();
  double yaw_rad = 0.0;  ///< of the heading frame about down, positive to the right, against any fixed direction

  /// Of a camera that looks ahead, upright.
  static Eigen::Matrix3d level();
  /// From the camera's axes to axes that do not turn with the vehicle.
  [[nodiscard]] Eigen::Matrix3d world_from_camera() const;
  /// How the camera has turned: from its axes at `other` to its axes here.
  [[nodiscard]] Eigen::Matrix3d turn_from(const Attitude& other) const;
};

/// A frame that is remembered, with what was known when it was taken.
struct Snapshot {
  Image image;  ///< empty where the signal needs no picture
  double captured_s = 0.0;
  std::optional<Attitude> attitude;
  std::shared_ptr<const void>
      tag;  ///< whatever the caller wants to find again in its signal; kept as long as the frame
};

/// Motion that is to be taken out of a pair before it is looked at: what need not be seen.
enum class CommonMotion : std::uint8_t {
  kNone,
  kRotation,  ///< the camera's turning, where attitudes are known
  kPlane,     ///< that of most of the picture: a wall, a table
};
const char* to_string(CommonMotion motion) noexcept;

/// What a signal says of a pair.
struct SignalMap {
  cv::Mat map;                      ///< CV_32F, scalar uncertainty on the first frame's grid
  cv::Mat valid;                    ///< CV_8U, 0 where the second frame has no picture for it; empty: everywhere
  std::optional<FlowSummary> flow;  ///< where a network made it
};

/// The uncertainty of the flow from `first` to `second`. Throws Error where there is none to be had.
using Signal = std::function<SignalMap(const Snapshot& first, const Snapshot& second, CommonMotion common)>;

/// What a network says of its own flow, after the common motion is taken out of the second frame; where that then has
/// no picture, the median uncertainty. Throws Error(kInvalidArgument) for a field of view outside (0, pi).
Signal network_signal(InferFunction infer, double horizontal_fov_rad,
                      tasks::ScalarKind scalar = tasks::ScalarKind::kNorm);

}  // namespace ajna::skills
