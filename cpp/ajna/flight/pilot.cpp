// SPDX-License-Identifier: MIT
#include "ajna/flight/pilot.hpp"

#include <cmath>
#include <cstring>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::flight {
namespace {

Image copy_of(const ImageView& view) {
  Image image(view.width, view.height);
  const auto row = static_cast<std::size_t>(view.width) * 3;
  for (int y = 0; y < view.height; ++y) {
    std::memcpy(image.data() + static_cast<std::size_t>(y) * row, view.data + y * view.row_stride, row);
  }
  return image;
}

/// A frame to compare with, and the field of the last comparison.
class FrameMemory {
 public:
  explicit FrameMemory(double max_interval_s) : max_interval_s_(max_interval_s) {}

  void keep(const ImageView& frame, double captured_s) {
    image_ = copy_of(frame);
    captured_s_ = captured_s;
  }
  void forget() { captured_s_.reset(); }
  /// Whether the remembered frame and this one can be a pair.
  [[nodiscard]] bool pairs_with(const ImageView& frame, double captured_s, double max_interval_s) const {
    return captured_s_ && captured_s > *captured_s_ && captured_s - *captured_s_ <= max_interval_s &&
           image_.width() == frame.width && image_.height() == frame.height;
  }
  [[nodiscard]] bool pairs_with(const ImageView& frame, double captured_s) const {
    return pairs_with(frame, captured_s, max_interval_s_);
  }
  const FlowField& compare(const ImageView& frame, double captured_s, const InferFunction& infer, PilotOutput& output) {
    infer(image_.view(), frame, field_, captured_s);
    output.flow = summarize(field_);
    return field_;
  }
  [[nodiscard]] double captured_s() const { return captured_s_.value_or(0.0); }

 private:
  double max_interval_s_;
  Image image_;
  std::optional<double> captured_s_;
  FlowField field_;
};

std::optional<Eigen::Vector3d> rates_of(const PilotInput& input, double from_s, bool wanted) {
  return wanted && input.rates ? input.rates(from_s, input.captured_s) : std::nullopt;
}

/// A pair of consecutive frames at every step; what tasks without a reference frame share.
class PairPilot : public Pilot {
 public:
  PilotOutput step(const PilotInput& input, const InferFunction& infer) final {
    PilotOutput output;
    if (!memory_.pairs_with(input.frame, input.captured_s)) {
      memory_.keep(input.frame, input.captured_s);
      output.status = "first_frame";
      output.valid = false;
      return output;
    }
    const double from_s = memory_.captured_s();
    try {
      const FlowField& field = memory_.compare(input.frame, input.captured_s, infer, output);
      decide(field, input, rates_of(input, from_s, use_gyro_), output);
    } catch (...) {  // whatever it is, the next frame is compared with this one, and the caller is told
      memory_.keep(input.frame, input.captured_s);
      throw;
    }
    memory_.keep(input.frame, input.captured_s);
    return output;
  }

 protected:
  explicit PairPilot(const PilotOptions& options) : memory_(options.max_interval_s), use_gyro_(options.use_gyro) {}
  virtual void decide(const FlowField& field, const PilotInput& input, const std::optional<Eigen::Vector3d>& rates,
                      PilotOutput& output) = 0;

 private:
  FrameMemory memory_;
  bool use_gyro_;
};

class DodgePilot final : public PairPilot {
 public:
  explicit DodgePilot(const PilotOptions& options)
      : PairPilot(options), pipeline_(options.dodge), policy_(options.dodge_policy) {}

  void begin(const PilotInput& /*input*/) override {
    pipeline_.reset();
    policy_.reset();
  }

 protected:
  void decide(const FlowField& field, const PilotInput& input, const std::optional<Eigen::Vector3d>& rates,
              PilotOutput& output) override {
    const auto map = tasks::scalar_map(field, pipeline_.options().map.scalar);
    const auto result = pipeline_.step(map, input.captured_s, rates);
    output.status = tasks::to_string(result.status);
    output.command = policy_.update(result.safe_direction, input.captured_s);
  }

 private:
  tasks::DodgePipeline pipeline_;
  control::DodgePolicy policy_;
};

class NavigatePilot final : public PairPilot {
 public:
  explicit NavigatePilot(const PilotOptions& options)
      : PairPilot(options),
        pipeline_(options.navigate),
        policy_(options.navigate_policy),
        bearing_rad_(options.goal_bearing_rad) {}

  void begin(const PilotInput& input) override {
    pipeline_.reset();
    policy_.reset();
    goal_yaw_rad_ = input.yaw_rad ? std::optional<double>(*input.yaw_rad + bearing_rad_) : std::nullopt;
  }

 protected:
  void decide(const FlowField& field, const PilotInput& input, const std::optional<Eigen::Vector3d>& rates,
              PilotOutput& output) override {
    const auto map = tasks::scalar_map(field, pipeline_.options().map.scalar);
    // Without a heading the goal stays where it was seen from: ahead, turned by the bearing.
    const double angle = goal_yaw_rad_ && input.yaw_rad ? *goal_yaw_rad_ - *input.yaw_rad : bearing_rad_;
    const auto result =
        pipeline_.step(map, input.captured_s, Eigen::Vector3d(std::cos(angle), std::sin(angle), 0.0), rates);
    output.status = tasks::to_string(result.status);
    std::optional<control::Guidance> guidance;
    if (result.status == tasks::NavigateStatus::kOk) {
      guidance = control::Guidance{result.goal_direction, result.free_direction, result.weight};
    }
    if (result.status == tasks::NavigateStatus::kBlocked) {
      policy_.reset();  // stop now, not when the last answer has run out
    }
    output.command = policy_.update(guidance, input.captured_s, input.velocity_m_s);
  }

 private:
  tasks::NavigatePipeline pipeline_;
  control::NavigatePolicy policy_;
  double bearing_rad_;
  std::optional<double> goal_yaw_rad_;
};

/// Explores, then servoes; the frames of the exploration are all compared with its first.
class GapPilot final : public Pilot {
 public:
  explicit GapPilot(const PilotOptions& options)
      : pipeline_(options.gap, options.horizontal_fov_rad),
        policy_(options.gap_policy),
        explore_(options.explore),
        reference_(options.max_interval_s) {
    control::explore(explore_, 0.0);  // throws for options out of range
  }

  void begin(const PilotInput& input) override {
    pipeline_.reset();
    policy_.reset();
    reference_.forget();
    explore_from_s_ = input.captured_s;
    sign_ = 1.0;
  }

  PilotOutput step(const PilotInput& input, const InferFunction& infer) override {
    PilotOutput output;
    if (!explore_from_s_) {
      begin(input);
    }
    cv::Mat map;
    if (pipeline_.wants_map()) {
      if (!reference_.pairs_with(input.frame, input.captured_s, kMaxExplore_s)) {
        restart(input);
      } else {
        map = tasks::scalar_map(reference_.compare(input.frame, input.captured_s, infer, output));
      }
    }
    const auto result = pipeline_.step(input.frame, map, input.captured_s);
    output.status = tasks::to_string(result.status);
    // The pipeline has taken this frame for its reference.
    if (result.status == tasks::GapStatus::kNoGap ||
        (result.status == tasks::GapStatus::kExploring && result.pairs == 0)) {
      reference_.keep(input.frame, input.captured_s);
    }
    output.command = command(result, input);
    return output;
  }

 private:
  static constexpr double kMaxExplore_s = 5.0;

  void restart(const PilotInput& input) {
    pipeline_.reset();
    explore_from_s_ = input.captured_s;
  }

  control::Command command(const tasks::GapResult& result, const PilotInput& input) {
    switch (result.status) {
      case tasks::GapStatus::kNoGap:
        // The way back, so that looking does not carry the vehicle off.
        sign_ = -sign_;
        explore_from_s_ = input.captured_s;
        return exploration(input);
      case tasks::GapStatus::kExploring:
        return exploration(input);
      case tasks::GapStatus::kTracking:
        return policy_.update(result.safe_offset, false, input.captured_s);
      case tasks::GapStatus::kThrough: {
        const auto command = policy_.update(std::nullopt, true, input.captured_s);
        return policy_.finished() ? control::Command::hold() : command;
      }
      case tasks::GapStatus::kLost:
        policy_.reset();
        reference_.forget();
        restart(input);
        return control::Command::hold();
      case tasks::GapStatus::kOutOfOrder:
      case tasks::GapStatus::kInvalidInput:
        break;
    }
    return control::Command::hold();
  }

  control::Command exploration(const PilotInput& input) {
    auto command = control::explore(explore_, input.captured_s - explore_from_s_.value_or(input.captured_s));
    command.velocity_m_s *= sign_;
    return command;
  }

  tasks::GapPipeline pipeline_;
  control::GapPolicy policy_;
  control::ExploreOptions explore_;
  FrameMemory reference_;
  std::optional<double> explore_from_s_;
  double sign_ = 1.0;
};

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

std::unique_ptr<Pilot> make_pilot(const PilotOptions& options) {
  if (!(options.max_interval_s > 0.0 && options.max_interval_s <= 1.0)) {
    throw_invalid("task.max_interval_s: give above 0 and at most 1");
  }
  if (!(std::abs(options.goal_bearing_rad) <= 3.15)) {
    throw_invalid("task.goal_bearing_rad: give -3.15 to 3.15");
  }
  PilotOptions checked = options;
  checked.dodge.horizontal_fov_rad = options.horizontal_fov_rad;
  checked.navigate.horizontal_fov_rad = options.horizontal_fov_rad;
  switch (options.task) {
    case Task::kDodge:
      return std::make_unique<DodgePilot>(checked);
    case Task::kNavigate:
      return std::make_unique<NavigatePilot>(checked);
    case Task::kGap:
      break;
  }
  return std::make_unique<GapPilot>(checked);
}

}  // namespace ajna::flight
