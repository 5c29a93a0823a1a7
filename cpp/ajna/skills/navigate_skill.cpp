// SPDX-License-Identifier: MIT
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <utility>

#include "ajna/geometry/camera.hpp"
#include "ajna/skills/dead_reckoning.hpp"
#include "ajna/skills/skill_parts.hpp"

namespace ajna::skills {
namespace {

tasks::NavigateOptions pipeline_options(const SkillOptions& options) {
  tasks::NavigateOptions navigate = options.navigate;
  navigate.horizontal_fov_rad = options.horizontal_fov_rad;
  return navigate;
}

/// How much later a command acts than it does where planning keeps pace with a camera of 30 Hz, for which the gains
/// are.
double delay_s(const SkillOptions& options) {
  constexpr double kUsual_hz = 30.0;
  return options.latency_s + std::max(0.0, 0.5 / options.planning_rate_hz - 0.5 / kUsual_hz);
}

control::NavigatePolicyOptions policy_options(const SkillOptions& options) {
  control::NavigatePolicyOptions policy = options.navigate_policy;
  policy.delay_s += delay_s(options);
  return policy;
}

double turn_between(const Attitude& a, const Attitude& b) {
  return std::abs(Eigen::AngleAxisd(a.turn_from(b)).angle());
}

/// Fly to the goal through what is free. Pairs span some time, so that what is near has moved by some pixels, and the
/// turning between them is taken out: what is left grows with inverse depth. The height is held by other sensors: of
/// the directions only the horizontal part is followed. Where attitude and velocity are known, uncertainty along the
/// horizon becomes distances, and a corridor between what stands there is chosen; else the largest free space is.
class NavigateSkill final : public Skill {
 public:
  NavigateSkill(const SkillOptions& options, Signal signal)
      : options_(options),
        signal_(std::move(signal)),
        max_age_s_(std::max(options.max_interval_s, 1.5 * options.longest_baseline_s)),
        memory_(max_age_s_),
        way_(options.corridor.camera_ahead_m, max_age_s_),
        pipeline_(pipeline_options(options)),
        planner_(options.corridor, options.occupancy),
        policy_(policy_options(options)) {
    tasks::validate(options.horizon);
  }

  void begin() override {
    pipeline_.reset();
    planner_.reset();
    policy_.reset();
    goal_yaw_rad_.reset();
    way_.reset();
    chosen_.reset();
    close_m_.reset();
    first_ = true;
  }

  void remember(const SkillInput& input) override { memory_.add(snapshot_of(input)); }

  SkillOutput plan(const SkillInput& input) override {
    return remembering(memory_, snapshot_of(input), [&](const Snapshot& now) { return decide(now, input); });
  }

 private:
  SkillOutput decide(const Snapshot& now, const SkillInput& input) {
    SkillOutput output;
    const Attitude attitude = input.attitude.value_or(Attitude{});
    const Eigen::Vector3d goal = levelled(goal_of(input), input.too_high_m);
    if (measured(input)) {
      way_.move(now.captured_s, attitude.yaw_rad, *input.velocity_m_s);
    } else {
      way_.lose();
    }
    const Snapshot* before = memory_.find(now.captured_s, interval_s(input), max_age_s_);
    const bool first = std::exchange(first_, false);
    if (before == nullptr || !same_size(now, *before)) {
      output.status = "first_frame";
      // Take off towards the goal: without motion there is no map. But once only: a camera whose frames never make
      // pairs must not be flown by.
      output.valid = first;
      if (first) {
        output.command =
            policy_.update(control::Guidance{goal, goal, 0.0, std::nullopt}, now.captured_s, input.velocity_m_s);
      }
      return output;
    }
    const SignalMap seen = signal_(now, *before, CommonMotion::kRotation);
    output.flow = seen.flow;
    output.map = seen.map;
    if (measured(input)) {
      const bool blurred = before->attitude && turn_between(*before->attitude, attitude) >
                                                   options_.max_turn_rad_s * (now.captured_s - before->captured_s);
      if (blurred || !fly_corridor(seen, before->captured_s, goal, input, output)) {
        // Nothing is to be seen of the way: the last answer stands for a while.
        output.status = blurred ? "turning" : "unseen";
        output.command = policy_.update(remembered(goal, attitude, input.too_high_m, now.captured_s), now.captured_s,
                                        input.velocity_m_s);
      }
      return output;
    }
    output.details = pipeline_.step(seen.map, now.captured_s, camera_from_heading(attitude, goal));
    const auto& result = std::get<tasks::NavigateResult>(output.details);
    output.status = tasks::to_string(result.status);
    output.mask = result.steps.mask;
    std::optional<control::Guidance> guidance;
    if (result.status == tasks::NavigateStatus::kOk) {
      const auto free = levelled(heading_from_camera(attitude, result.free_direction), input.too_high_m);
      guidance = control::Guidance{goal, free, result.weight, std::nullopt};
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

  static bool measured(const SkillInput& input) { return input.attitude && input.velocity_m_s; }

  /// How far apart the frames of a pair should be: further while the vehicle is slow, less where something is near.
  [[nodiscard]] double interval_s(const SkillInput& input) const {
    const double speed =
        std::max(measured(input) ? input.velocity_m_s->norm() : options_.navigate_policy.speed_m_s, 1e-3);
    const double interval = std::clamp(options_.baseline_m / speed, options_.baseline_s, options_.longest_baseline_s);
    if (!measured(input) || !close_m_) {
      return interval;
    }
    const double shortest = std::min(options_.shortest_baseline_s, interval);
    return std::clamp(options_.baseline_share * *close_m_ / speed, shortest, interval);
  }

  /// Choose a corridor between the things that the map shows along the horizon; false where it shows nothing.
  bool fly_corridor(const SignalMap& seen, double before_s, const Eigen::Vector3d& goal, const SkillInput& input,
                    SkillOutput& output) {
    const Attitude& attitude = *input.attitude;
    const double time_s = input.captured_s;
    const cv::Mat& map = seen.map;
    if (!tasks::is_valid_map(map)) {
      return false;
    }
    output.status = tasks::to_string(tasks::NavigateStatus::kOk);
    // A vehicle that speeds up has come less far than its present velocity says.
    const Eigen::Vector3d moved_m =
        way_.moved_since(before_s).value_or((input.captured_s - before_s) * *input.velocity_m_s);
    const auto scan = tasks::horizon_scan(map, seen.valid, attitude.heading_from_camera, options_.horizontal_fov_rad,
                                          moved_m, options_.horizon);
    if (!scan && moved_m.norm() >= options_.horizon.min_move_m) {
      return false;
    }
    // At rest there is nothing to be seen: what the map holds counts.
    const auto corridor = planner_.plan(scan, way_.position_m().head<2>(), attitude.yaw_rad,
                                        std::atan2(goal.y(), goal.x()), start_of(*input.velocity_m_s, time_s));
    const Eigen::Vector3d free =
        levelled({std::cos(corridor.angle_rad), std::sin(corridor.angle_rad), 0.0}, input.too_high_m);
    const control::Guidance guidance{goal, free, weight_of(corridor), corridor.speed_m_s};
    const auto camera = geometry::Camera::from_horizontal_fov(map.cols, map.rows, options_.horizontal_fov_rad);
    const auto pixel = [&](const Eigen::Vector3d& direction) {
      return camera.project(attitude.heading_from_camera.transpose() * direction);
    };
    output.point_px = pixel(control::desired_direction(guidance));
    output.command = policy_.update(guidance, time_s, input.velocity_m_s);
    close_m_ = corridor.close_m;
    chosen_ = Chosen{time_s, attitude.yaw_rad + corridor.angle_rad, guidance.weight, corridor.speed_m_s};
    // What is near, as upright lines of a third of a metre, for pictures.
    constexpr double kHalfHeight_m = 0.15;
    output.mask = cv::Mat::zeros(map.size(), CV_8U);
    for (const auto& thing : scan ? scan->all_things() : tasks::Obstacles{}) {
      const auto low = pixel({thing.x(), thing.y(), kHalfHeight_m});
      const auto high = pixel({thing.x(), thing.y(), -kHalfHeight_m});
      if (low && high) {
        cv::line(output.mask, {cvRound(low->x()), cvRound(low->y())}, {cvRound(high->x()), cvRound(high->y())},
                 cv::Scalar(255), options_.horizon.column_step);
      }
    }
    return true;
  }

  /// Where the command of now will find the vehicle.
  [[nodiscard]] tasks::CorridorStart start_of(const Eigen::Vector3d& velocity_m_s, double time_s) const {
    const auto pending = policy_.pending(time_s);
    const Eigen::Vector3d moved_m = policy_.options().delay_s * velocity_m_s + pending.moved_m;
    return {(velocity_m_s + pending.gained_m_s).head<2>(), moved_m.head<2>()};
  }

  /// The last choice, for a heading that has turned since; nothing where it is too old.
  [[nodiscard]] std::optional<control::Guidance> remembered(const Eigen::Vector3d& goal, const Attitude& attitude,
                                                            double too_high_m, double time_s) const {
    if (!chosen_ || time_s - chosen_->time_s > options_.navigate_policy.lookahead_s) {
      return std::nullopt;
    }
    const double angle = chosen_->direction_rad - attitude.yaw_rad;
    return control::Guidance{goal, levelled({std::cos(angle), std::sin(angle), 0.0}, too_high_m), chosen_->weight,
                             chosen_->speed_m_s};
  }

  /// w of Eq. 3: the corridor alone counts where the way to the goal is not free.
  [[nodiscard]] double weight_of(const tasks::Corridor& corridor) const {
    const double far = options_.corridor.horizon_m;
    if (corridor.goal_free_m < far) {
      return 1.0;
    }
    const double near = std::max(corridor.close_m, 0.1);
    return tasks::navigation_weight(options_.navigate.weight, 1.0 / near, 1.0 / std::max(corridor.free_m, near),
                                    1.0 / far, 1.0 / far);
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

  /// A corridor, in axes that do not turn with the vehicle.
  struct Chosen {
    double time_s;
    double direction_rad;
    double weight;
    double speed_m_s;
  };

  SkillOptions options_;
  Signal signal_;
  double max_age_s_;
  Memory memory_;
  DeadReckoning way_;
  tasks::NavigatePipeline pipeline_;
  tasks::CorridorPlanner planner_;
  control::NavigatePolicy policy_;
  std::optional<double> goal_yaw_rad_;
  std::optional<Chosen> chosen_;
  std::optional<double> close_m_;  ///< to the nearest thing ahead
  bool first_ = true;
};

}  // namespace

std::unique_ptr<Skill> make_navigate_skill(const SkillOptions& options, Signal signal) {
  return std::make_unique<NavigateSkill>(options, std::move(signal));
}

}  // namespace ajna::skills
