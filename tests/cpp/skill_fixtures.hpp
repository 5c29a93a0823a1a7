// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>

#include <memory>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/skills/skill.hpp"

namespace ajna::skills {

constexpr int kWidth = 160;
constexpr int kHeight = 120;

/// What a signal was asked for.
struct Asked {
  double first_s;
  double second_s;
  CommonMotion common;
};

class SkillTest : public ::testing::Test {
 protected:
  std::vector<Asked> asked;
  bool fails = false;
  cv::Mat map = cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(0.2F));
  Image picture = Image(kWidth, kHeight);

  Signal signal() {
    return [this](const Snapshot& first, const Snapshot& second, CommonMotion common) {
      asked.push_back({first.captured_s, second.captured_s, common});
      if (fails) {
        throw_runtime("the network gave NaN");
      }
      return SignalMap{map.clone(), {}, std::nullopt};
    };
  }
  std::unique_ptr<Skill> make(Task task, double planning_rate_hz = 30.0) {
    SkillOptions options;
    options.task = task;
    options.planning_rate_hz = planning_rate_hz;
    return make_skill(options, signal());
  }
  [[nodiscard]] SkillInput at(double time_s) const {
    SkillInput input;
    input.captured_s = time_s;
    input.frame = picture.view();
    input.attitude = Attitude{};
    input.velocity_m_s = Eigen::Vector3d::Zero();
    return input;
  }
  /// A disc that is certain to be uncertain.
  void draw(double x, double radius) {
    map = cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(0.2F));
    cv::circle(map, {static_cast<int>(x), kHeight / 2}, static_cast<int>(radius), cv::Scalar(1.6F), cv::FILLED);
  }
};

}  // namespace ajna::skills
