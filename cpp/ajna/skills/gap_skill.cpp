// SPDX-License-Identifier: MIT
#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/skills/skill_parts.hpp"
#include "ajna/tasks/align.hpp"

namespace ajna::skills {
namespace {

constexpr double kLongestStep_s = 0.25;  ///< a longer pause does not let the commanded velocity jump

tasks::GapOptions pipeline_options(const SkillOptions& options) {
  const auto plans = [&](double duration_s) {
    return std::max(options.fewest_pairs, static_cast<int>(std::lround(duration_s * options.planning_rate_hz)));
  };
  tasks::GapOptions gap = options.gap;
  gap.min_pairs = plans(options.first_look_s);
  gap.max_pairs = std::max(plans(options.last_look_s), gap.min_pairs + options.fewest_pairs);
  return gap;
}

control::ExploreOptions explore_options(const SkillOptions& options) {
  control::ExploreOptions explore = options.explore;
  explore.duration_s = 2.0 * options.last_look_s;  // until the pipeline says that it has seen enough
  return explore;
}

std::vector<cv::Point2f> mapped(const cv::Matx33d& homography, const std::vector<cv::Point2f>& points) {
  std::vector<cv::Point2f> result;
  result.reserve(points.size());
  for (const auto& point : points) {
    const cv::Vec3d h = homography * cv::Vec3d(point.x, point.y, 1.0);
    result.emplace_back(static_cast<float>(h[0] / h[2]), static_cast<float>(h[1] / h[2]));
  }
  return result;
}

/// Explore, find the gap, fly through it. The vehicle begins at rest; maps are stacked on the frame that the
/// exploratory motion began with. What the pipeline tracks are frames from which roll and pitch, where known, are taken
/// out. Where no gap is found, or it is lost, it stops and explores anew, each time the other way.
class GapSkill final : public Skill {
 public:
  GapSkill(const SkillOptions& options, Signal signal)
      : options_(options),
        signal_(std::move(signal)),
        pipeline_(pipeline_options(options), options.horizontal_fov_rad),
        policy_(options.gap_policy),
        explore_(explore_options(options)) {
    control::explore(explore_, 0.0);  // throws for options out of range
  }

  void begin() override {
    reference_.reset();
    velocity_.setZero();
    planned_s_.reset();
    settled_s_.reset();
    rounds_ = 0;
    decided_ = false;
  }

  void remember(const SkillInput& /*input*/) override {}

  SkillOutput plan(const SkillInput& input) override {
    const double time_s = input.captured_s;
    SkillOutput output;
    if (!std::isfinite(time_s) || (planned_s_ && time_s <= *planned_s_)) {
      output.status = tasks::to_string(tasks::GapStatus::kOutOfOrder);
      output.valid = false;
      return output;
    }
    const double dt_s = planned_s_ ? time_s - *planned_s_ : 1.0 / options_.planning_rate_hz;
    planned_s_ = time_s;
    step_m_s_ = options_.slew_m_s2 * std::min(dt_s, kLongestStep_s);
    if (!settled_s_) {
      settled_s_ = time_s + options_.settle_s;
    }
    if (!reference_) {
      return begin_to_explore(input);
    }
    return look(input);
  }

 private:
  SkillOutput begin_to_explore(const SkillInput& input) {
    SkillOutput output;
    if (input.captured_s < *settled_s_ - 1e-9 || !at_rest(input)) {
      output.status = "settling";
      output.command = toward(Eigen::Vector3d::Zero());
      return output;
    }
    ++rounds_;
    reference_ = snapshot_of(input);
    pipeline_.reset();
    policy_.reset();
    auto result = pipeline_.step(input.frame, {}, input.captured_s);
    output.status = tasks::to_string(result.status);
    output.details = std::move(result);
    output.command = wobble(0.0);
    return output;
  }

  SkillOutput look(const SkillInput& input) {
    SkillOutput output;
    cv::Mat map;
    if (pipeline_.wants_map()) {
      const Snapshot now = snapshot_of(input);
      if (!same_size(now, *reference_)) {
        throw_invalid("frame is " + std::to_string(now.image.width()) + "x" + std::to_string(now.image.height()) +
                      ", the one that the exploration began with was of another size");
      }
      SignalMap seen = signal_(*reference_, now, CommonMotion::kPlane);
      map = seen.map;
      output.flow = seen.flow;
      output.map = map;
    }
    tasks::Alignment stable;
    ImageView frame = input.frame;
    if (input.attitude) {
      const Eigen::Matrix3d level = Attitude::level().transpose() * input.attitude->heading_from_camera;
      stable = tasks::derotate_frame(input.frame, level, options_.horizontal_fov_rad);
      frame = {stable.image.data, stable.image.cols, stable.image.rows, 3,
               static_cast<std::ptrdiff_t>(stable.image.step[0])};
    }
    output.details = pipeline_.step(frame, map, input.captured_s);
    const auto& result = std::get<tasks::GapResult>(output.details);
    output.status = tasks::to_string(result.status);
    output.command = command(result, input);
    if (result.status == tasks::GapStatus::kTracking) {
      output.decided = !std::exchange(decided_, true);
      show(result, stable.reference_from_frame.inv(), input.frame, output);
    }
    return output;
  }

  control::Command command(const tasks::GapResult& result, const SkillInput& input) {
    switch (result.status) {
      case tasks::GapStatus::kExploring:
        return wobble(input.captured_s - reference_->captured_s);
      case tasks::GapStatus::kTracking:
        return follow(policy_.update(result.safe_offset, false, input.captured_s));
      case tasks::GapStatus::kThrough:
        return follow(policy_.update(std::nullopt, true, input.captured_s));
      case tasks::GapStatus::kNoGap:
      case tasks::GapStatus::kLost:
      case tasks::GapStatus::kOutOfOrder:
      case tasks::GapStatus::kInvalidInput:
        break;
    }
    reference_.reset();
    if (!input.velocity_m_s) {
      settled_s_ = input.captured_s + 2.0 * options_.settle_s;  // when it is at rest is then only known by waiting
    }
    return toward(Eigen::Vector3d::Zero());
  }

  /// Contour and safe point, which lie in the levelled frame, in the frame as it came.
  static void show(const tasks::GapResult& result, const cv::Matx33d& back, const ImageView& frame,
                   SkillOutput& output) {
    std::vector<cv::Point> outline;
    for (const auto& point : mapped(back, result.contour)) {
      outline.emplace_back(cvRound(point.x), cvRound(point.y));
    }
    output.mask = cv::Mat::zeros(frame.height, frame.width, CV_8U);
    if (!outline.empty()) {
      cv::fillPoly(output.mask, std::vector<std::vector<cv::Point>>{outline}, cv::Scalar(255));
    }
    const auto safe =
        mapped(back, {cv::Point2f(static_cast<float>(result.safe_px.x()), static_cast<float>(result.safe_px.y()))});
    output.point_px = Eigen::Vector2d(safe[0].x, safe[0].y);
  }

  [[nodiscard]] bool at_rest(const SkillInput& input) const {
    if (input.velocity_m_s && input.velocity_m_s->norm() > options_.rest_m_s) {
      return false;
    }
    if (!input.attitude) {
      return true;
    }
    // How far the optical axis is from level and straight ahead.
    const Eigen::Matrix3d level = Attitude::level().transpose() * input.attitude->heading_from_camera;
    return std::acos(std::clamp(level(2, 2), -1.0, 1.0)) <= options_.rest_rad;
  }

  /// A velocity in steps that do not tilt the camera much.
  control::Command toward(const Eigen::Vector3d& velocity_m_s) {
    velocity_ += control::limit_norm(velocity_m_s - velocity_, step_m_s_);
    return control::Command::velocity(velocity_);
  }
  control::Command follow(const control::Command& wanted) { return toward(wanted.velocity_m_s); }
  control::Command wobble(double elapsed_s) {
    const double way = rounds_ % 2 == 1 ? 1.0 : -1.0;
    return toward(way * control::explore(explore_, elapsed_s).velocity_m_s);
  }

  SkillOptions options_;
  Signal signal_;
  tasks::GapPipeline pipeline_;
  control::GapPolicy policy_;
  control::ExploreOptions explore_;
  std::optional<Snapshot> reference_;
  Eigen::Vector3d velocity_ = Eigen::Vector3d::Zero();
  double step_m_s_ = 0.0;
  std::optional<double> planned_s_;
  std::optional<double> settled_s_;  ///< not before this time is the vehicle taken to be at rest
  int rounds_ = 0;
  bool decided_ = false;
};

}  // namespace

std::unique_ptr<Skill> make_gap_skill(const SkillOptions& options, Signal signal) {
  return std::make_unique<GapSkill>(options, std::move(signal));
}

}  // namespace ajna::skills
