// SPDX-License-Identifier: MIT
// Skills on what cannot be used: a failed network, frames that make no pair, maps and sensors that say no number.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <functional>
#include <limits>
#include <opencv2/core.hpp>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/skills/skill.hpp"
#include "skill_fixtures.hpp"

namespace ajna::skills {
namespace {

TEST_F(SkillTest, SensorsThatSayNoNumberAreNotHeard) {
  const double nan = std::nan("");
  for (const Task task : {Task::kDodge, Task::kNavigate, Task::kGap}) {
    const auto fly = [&](const std::function<void(SkillInput&)>& spoil) {
      const auto skill = make(task);
      std::vector<SkillOutput> outputs;
      for (int i = 0; i < 30; ++i) {
        SkillInput input = at(i / 30.0);
        input.velocity_m_s = Eigen::Vector3d(1.0, 0.1, 0.0);
        if (i == 12) {
          spoil(input);
        }
        outputs.push_back(skill->plan(input));
        const auto& command = outputs.back().command;
        EXPECT_TRUE(command.velocity_m_s.allFinite() && command.acceleration_m_s2.allFinite() &&
                    std::isfinite(command.yaw_rate_rad_s));
      }
      return outputs;
    };
    const auto without = fly([](SkillInput& input) {
      input.attitude.reset();
      input.velocity_m_s.reset();
    });
    const auto yaw = fly([&](SkillInput& input) {
      input.attitude->yaw_rad = nan;
      input.velocity_m_s = Eigen::Vector3d(1.0, nan, 0.0);
    });
    const auto rotation = fly([&](SkillInput& input) {
      input.attitude->heading_from_camera(1, 2) = nan;
      input.velocity_m_s->x() = std::numeric_limits<double>::infinity();
    });
    for (std::size_t i = 0; i < without.size(); ++i) {
      for (const auto* other : {&yaw[i], &rotation[i]}) {
        EXPECT_EQ(other->status, without[i].status) << i;
        EXPECT_EQ(other->command.acceleration_m_s2, without[i].command.acceleration_m_s2) << i;
        EXPECT_EQ(other->command.velocity_m_s, without[i].command.velocity_m_s) << i;
      }
    }
  }
}

TEST_F(SkillTest, FramesOfAnotherSizeAreNoPair) {
  const auto skill = make(Task::kDodge);
  skill->plan(at(0.0));
  picture = Image(80, 60);
  EXPECT_FALSE(skill->plan(at(0.05)).valid);
  map = cv::Mat(60, 80, CV_32F, cv::Scalar(0.2F));
  EXPECT_TRUE(skill->plan(at(0.1)).valid);
}

TEST_F(SkillTest, MapsThatCannotBeUsedGiveNoCommandToMove) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  for (const cv::Mat& bad :
       {cv::Mat(), cv::Mat(1, 1, CV_32F, cv::Scalar(1.0F)), cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(nan))}) {
    const auto skill = make(Task::kDodge);
    map = bad;
    skill->plan(at(0.0));
    for (int i = 1; i < 6; ++i) {
      const auto output = skill->plan(at(0.03 * i));
      EXPECT_EQ(output.status, "invalid_input");
      EXPECT_EQ(output.command.mode, control::CommandMode::kHold);
    }
  }
}

TEST_F(SkillTest, AFailedSignalIsToldAndTheFrameKept) {
  for (const Task task : {Task::kDodge, Task::kNavigate}) {
    const auto skill = make(task);
    skill->plan(at(0.0));
    fails = true;
    EXPECT_THROW(skill->plan(at(0.05)), Error);
    fails = false;
    asked.clear();
    EXPECT_TRUE(skill->plan(at(task == Task::kDodge ? 0.2 : 0.1)).valid);
    ASSERT_EQ(asked.size(), 1U);
    EXPECT_EQ(asked[0].second_s, task == Task::kDodge ? 0.05 : 0.0);
  }
}

}  // namespace
}  // namespace ajna::skills
