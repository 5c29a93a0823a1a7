// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "ajna/base/flow_field.hpp"
#include "ajna/base/image_view.hpp"
#include "ajna/control/command.hpp"
#include "ajna/control/policies.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/gap.hpp"
#include "ajna/tasks/navigate.hpp"

namespace ajna::flight {

/// Flow and uncertainty from frame 1 to frame 2 into a field. Throws Error where the network fails or gives values that
/// are not finite. The engine stands behind it in the program, something else in tests.
using InferFunction =
    std::function<void(const ImageView& frame1, const ImageView& frame2, FlowField& field, double timestamp_s)>;

enum class Task : std::uint8_t { kDodge, kNavigate, kGap };
const char* to_string(Task task) noexcept;

struct PilotOptions {
  Task task = Task::kDodge;
  double max_interval_s = 0.2;      ///< between the frames of a pair; frames further apart are not compared
  double horizontal_fov_rad = 1.2;  ///< of the camera, which looks along the body's forward axis
  double goal_bearing_rad = 0.0;    ///< navigate: to the right of the heading at activation
  bool use_gyro = true;             ///< take the vehicle's rotation out of what is seen
  tasks::DodgeOptions dodge;
  control::DodgePolicyOptions dodge_policy;
  tasks::NavigateOptions navigate;
  control::NavigatePolicyOptions navigate_policy;
  tasks::GapOptions gap;
  control::GapPolicyOptions gap_policy;
  control::ExploreOptions explore;
};

/// What a pilot is given at a frame.
struct PilotInput {
  ImageView frame;
  double captured_s = 0.0;
  std::optional<double> yaw_rad;
  std::optional<Eigen::Vector3d> velocity_m_s;  ///< levelled body frame
  /// Mean angular velocity in the optical frame between two times; may be null.
  std::function<std::optional<Eigen::Vector3d>(double from_s, double to_s)> rates;
};

/// What it makes of it.
struct PilotOutput {
  control::Command command;
  std::string status;               ///< of the pipeline
  std::optional<FlowSummary> flow;  ///< where the network ran
  bool valid = true;                ///< false where this frame could not be compared with another
};

/// Perception and policy of one task, with the frames they remember. Used by one thread.
class Pilot {
 public:
  virtual ~Pilot() = default;
  Pilot() = default;
  Pilot(const Pilot&) = delete;
  Pilot& operator=(const Pilot&) = delete;

  /// Frames come in order. Throws what `infer` throws; nothing of the pilot is changed then but the frame it remembers.
  virtual PilotOutput step(const PilotInput& input, const InferFunction& infer) = 0;
  /// Begin anew: commands start to count now. Runs at each activation.
  virtual void begin(const PilotInput& input) = 0;
};

/// Throws Error(kInvalidArgument) for options out of range.
std::unique_ptr<Pilot> make_pilot(const PilotOptions& options);

}  // namespace ajna::flight
