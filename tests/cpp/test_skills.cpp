// SPDX-License-Identifier: MIT
// Skills on made-up signals: which frames make a pair, when a decision falls, what is done where nothing is known.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <memory>
#include <opencv2/imgproc.hpp>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/skills/skill.hpp"
#include "skill_fixtures.hpp"

namespace ajna::skills {
namespace {

TEST_F(SkillTest, DodgePairsGoBackToAnOlderFrame) {
  const auto skill = make(Task::kDodge);
  const SkillOutput first = skill->plan(at(1.0));
  EXPECT_FALSE(first.valid);
  EXPECT_EQ(first.status, "first_frame");
  skill->plan(at(1.1));
  skill->remember(at(1.17));
  skill->plan(at(1.2));
  ASSERT_EQ(asked.size(), 2U);
  EXPECT_EQ(asked[0].first_s, 1.1);
  EXPECT_EQ(asked[0].second_s, 1.0);
  EXPECT_EQ(asked[1].second_s, 1.0) << "the one that is nearest to dodge_pair_s ago";
  EXPECT_EQ(asked[1].common, CommonMotion::kRotation);
  EXPECT_FALSE(skill->plan(at(1.5)).valid) << "too far from the last one";
  EXPECT_FALSE(skill->plan(at(1.4)).valid) << "out of order";
  EXPECT_EQ(asked.size(), 2U);
}

TEST_F(SkillTest, DodgePairsMayBeNeighbours) {
  SkillOptions options;
  options.dodge_pair_s = 0.0;
  const auto skill = make_skill(options, signal());
  skill->plan(at(1.0));
  skill->plan(at(1.1));
  skill->remember(at(1.17));
  skill->plan(at(1.2));
  EXPECT_EQ(asked.back().second_s, 1.17) << "a frame that was only remembered makes the pair shorter";
  options.dodge_pair_s = options.max_interval_s + 0.1;
  EXPECT_THROW(validate(options), Error);
}

TEST_F(SkillTest, DodgeDecidesOnce) {
  const auto skill = make(Task::kDodge);
  std::vector<int> decided;
  for (int i = 0; i < 8; ++i) {
    draw(100 + i, 6 + i);
    const auto output = skill->plan(at(0.033 * i));
    if (output.decided) {
      decided.push_back(i);
      EXPECT_EQ(output.status, "incoming");
      EXPECT_EQ(output.command.mode, control::CommandMode::kAcceleration);
      EXPECT_LT(output.command.velocity_m_s.y(), -1.0) << "it drifts to the right";
      ASSERT_TRUE(output.point_px);
      EXPECT_NEAR(output.point_px->x(), 100 + i, 3);
      EXPECT_GT(output.mask.at<unsigned char>(kHeight / 2, 100 + i), 0);
    }
  }
  EXPECT_EQ(decided, std::vector<int>{3});
  skill->begin();
  const auto again = skill->plan(at(0.033 * 8));
  EXPECT_TRUE(again.valid) << "frames are remembered over an activation";
  EXPECT_EQ(again.command.mode, control::CommandMode::kHold) << "but nothing that was decided";
}

TEST_F(SkillTest, DodgeDecidesOnTwoDetectionsWhereTheyAreAsFarApartAsThree) {
  for (const auto& [rate_hz, frame] : {std::pair{8.0, 2}, {15.0, 2}, {20.0, 3}, {60.0, 3}}) {
    const auto skill = make(Task::kDodge, rate_hz);
    int decided = -1;
    for (int i = 0; i < 8 && decided < 0; ++i) {
      draw(80 + 3 * i, 6 + i);
      decided = skill->plan(at(i / rate_hz)).decided ? i : decided;
    }
    EXPECT_EQ(decided, frame) << rate_hz << " Hz";
  }
}

/// A picture with a white square on a grey ground.
Image square_at(int left, int top, int side) {
  Image picture(2 * kWidth, 2 * kHeight);
  std::fill(picture.data(), picture.data() + picture.size_bytes(), std::uint8_t{90});
  cv::Mat pixels(2 * kHeight, 2 * kWidth, CV_8UC3, picture.data());
  cv::rectangle(pixels, cv::Rect(left, top, side, side), cv::Scalar(255, 255, 255), cv::FILLED);
  return picture;
}

TEST(DodgeSkill, OutlinesWhatItFoundByACloserLook) {
  // A map that shows where two pictures differ, blurred by as many of their own pixels as a network's.
  std::vector<cv::Size> asked;
  const Signal blurred = [&asked](const Snapshot& first, const Snapshot& second, CommonMotion) {
    const auto grey = [](const Snapshot& frame) {
      const cv::Mat pixels(frame.image.height(), frame.image.width(), CV_8UC3,
                           const_cast<std::uint8_t*>(frame.image.data()));
      cv::Mat result;
      cv::cvtColor(pixels, result, cv::COLOR_RGB2GRAY);
      return result;
    };
    asked.emplace_back(first.image.width(), first.image.height());
    cv::Mat difference;
    cv::Mat(grey(first) - grey(second)).convertTo(difference, CV_32F, 1.0 / 40.0, 0.2);  // what is new in the first
    cv::GaussianBlur(difference, difference, {}, 4.0);
    return SignalMap{difference, {}, std::nullopt};
  };
  constexpr int kSide = 6;
  const auto skill = make_skill({}, blurred);
  EXPECT_TRUE(skill->outline().empty()) << "before the first frame";
  bool found = false;
  for (int i = 0; i < 20; ++i) {
    const bool thrown = i >= 8;
    const int left = thrown ? 60 + 4 * (i - 8) : -20;
    const Image picture = square_at(left, 100, kSide);
    SkillInput input;
    input.captured_s = i / 30.0;
    input.frame = picture.view();
    input.attitude = i % 2 == 0 ? std::optional(Attitude{}) : std::nullopt;  // with and without derotation
    const SkillOutput output = skill->plan(input);
    asked.clear();
    const cv::Mat outlined = skill->outline();
    EXPECT_EQ(outlined.empty(), output.mask.empty()) << i;
    if (output.mask.empty()) {
      EXPECT_TRUE(asked.empty()) << "nothing to look at";
      continue;
    }
    found = true;
    EXPECT_EQ(asked, std::vector({cv::Size(240, 176)}));
    cv::Mat truth(output.mask.size(), CV_8U, cv::Scalar(0));
    cv::rectangle(truth, cv::Rect(left, 100, kSide, kSide), 255, cv::FILLED);
    const auto overlap = [&truth](const cv::Mat& mask) {
      return static_cast<double>(cv::countNonZero(mask & truth)) / cv::countNonZero(mask | truth);
    };
    EXPECT_LT(overlap(output.mask), 0.4);
    EXPECT_GT(overlap(outlined), 0.6) << i;
  }
  EXPECT_TRUE(found);
  skill->begin();
  EXPECT_TRUE(skill->outline().empty()) << "begun anew";
}

TEST_F(SkillTest, NothingIsOutlinedWithoutPicturesOrByASignalThatTakesNone) {
  for (const bool pictures : {true, false}) {
    const auto skill = make(Task::kDodge);
    bool found = false;
    for (int i = 0; i < 12; ++i) {
      draw(40.0 + 2.0 * i, 10.0);
      SkillInput input = at(i / 30.0);
      input.frame = pictures ? input.frame : ImageView{};
      const bool seen = !skill->plan(input).mask.empty();
      EXPECT_TRUE(skill->outline().empty()) << "the map is no enlarged one";
      found = found || seen;
    }
    EXPECT_TRUE(found);
  }
  const auto other = make(Task::kNavigate);
  other->plan(at(0.0));
  EXPECT_TRUE(other->outline().empty());
}

TEST_F(SkillTest, NavigatePairsSpanTheBaselineWithoutTurning) {
  const auto skill = make(Task::kNavigate);
  const SkillOptions defaults;
  const double baseline_s = defaults.longest_baseline_s;  // at rest
  for (int i = 0; i < 15; ++i) {
    skill->plan(at(i / 30.0));
  }
  ASSERT_EQ(asked.size(), 14U);
  EXPECT_NEAR(asked.back().first_s - asked.back().second_s, baseline_s, 1e-9);
  // A late frame: the pair is longer, not missing.
  skill->plan(at(14 / 30.0 + baseline_s + 0.02));
  EXPECT_NEAR(asked.back().first_s - asked.back().second_s, baseline_s + 0.02, 1e-9);
  EXPECT_EQ(asked.back().common, CommonMotion::kRotation);
}

TEST_F(SkillTest, NavigatePairsAreShorterWhereSomethingIsNearAndLongerForASlowVehicle) {
  const auto fly = [&](double uncertainty, double speed_m_s) {
    map = cv::Mat(kHeight, kWidth, CV_32F, cv::Scalar(uncertainty));
    const auto skill = make(Task::kNavigate);
    asked.clear();
    for (int i = 0; i < 20; ++i) {
      SkillInput input = at(i / 30.0);
      input.velocity_m_s = Eigen::Vector3d(speed_m_s, 0.0, 0.0);
      skill->plan(input);
    }
    return asked.back().first_s - asked.back().second_s;
  };
  const SkillOptions defaults;
  EXPECT_NEAR(fly(0.1, 4.0), defaults.baseline_s, 0.02);
  EXPECT_NEAR(fly(0.1, 1.2), defaults.baseline_m / 1.2, 0.02);
  EXPECT_NEAR(fly(0.1, 0.5), defaults.longest_baseline_s, 0.02) << "no longer, however slow";
  EXPECT_NEAR(fly(1.5, 4.0), defaults.shortest_baseline_s, 0.02) << "no shorter, however near";
}

TEST_F(SkillTest, NavigateSetsOutOnceWithoutAPair) {
  const auto skill = make(Task::kNavigate);
  const auto first = skill->plan(at(0.0));
  EXPECT_TRUE(first.valid);
  EXPECT_GT(first.command.acceleration_m_s2.x(), 0.5);
  const auto second = skill->plan(at(1.0));
  EXPECT_FALSE(second.valid) << "frames that make no pairs are not flown by";
  EXPECT_TRUE(asked.empty());
}

TEST_F(SkillTest, NavigateKeepsTheBearingOfTheBeginning) {
  const auto skill = make(Task::kNavigate);
  SkillInput input = at(0.0);
  input.attitude->yaw_rad = 1.0;
  skill->plan(input);
  input = at(0.1);
  input.attitude->yaw_rad = 1.1;  // turned to the right: the goal is on the left now
  const auto output = skill->plan(input);
  ASSERT_TRUE(output.point_px);
  const double focal = 0.5 * kWidth / std::tan(0.6);
  EXPECT_NEAR(output.point_px->x(), 0.5 * (kWidth - 1) - focal * std::tan(0.1), 2.0);
  EXPECT_LT(output.command.yaw_rate_rad_s, -0.05);
  EXPECT_EQ(output.command.velocity_m_s.z(), 0.0);
}

TEST_F(SkillTest, NavigateFollowsTheHeightNotTheMap) {
  const auto skill = make(Task::kNavigate);
  skill->plan(at(0.0));
  SkillInput input = at(0.1);
  input.too_high_m = 0.5;
  const auto down = skill->plan(input);
  EXPECT_GT(down.command.acceleration_m_s2.z(), 0.1);
}

TEST_F(SkillTest, GapWaitsForRestAndLooksFromOneReference) {
  const auto skill = make(Task::kGap, 10.0);
  SkillInput moving = at(0.0);
  moving.velocity_m_s = Eigen::Vector3d(0.5, 0, 0);
  EXPECT_EQ(skill->plan(at(0.0)).status, "settling");
  moving.captured_s = 0.4;
  EXPECT_EQ(skill->plan(moving).status, "settling") << "it still moves";
  SkillInput tilted = at(0.5);
  tilted.attitude->heading_from_camera =
      Eigen::AngleAxisd(0.2, Eigen::Vector3d::UnitY()) * tilted.attitude->heading_from_camera;
  EXPECT_EQ(skill->plan(tilted).status, "settling") << "it is tilted";
  EXPECT_EQ(skill->plan(at(0.6)).status, "exploring");
  const auto exploring = skill->plan(at(0.7));
  EXPECT_GT(exploring.command.velocity_m_s.norm(), 0.1);
  skill->plan(at(0.8));
  ASSERT_EQ(asked.size(), 2U);
  EXPECT_EQ(asked[0].first_s, 0.6);
  EXPECT_EQ(asked[1].first_s, 0.6);
  EXPECT_EQ(asked[1].second_s, 0.8);
  EXPECT_EQ(asked[1].common, CommonMotion::kPlane);
}

TEST_F(SkillTest, GapExploresTheOtherWayWhereNoneIsFound) {
  const auto skill = make(Task::kGap, 10.0);
  std::vector<double> right;
  bool no_gap = false;
  for (int i = 0; i < 40; ++i) {
    const auto output = skill->plan(at(0.1 * i));
    no_gap = no_gap || output.status == "no_gap";
    if (output.status == "exploring") {
      right.push_back(output.command.velocity_m_s.y());
    }
    ASSERT_LE(output.command.velocity_m_s.norm(), 0.51);
  }
  EXPECT_TRUE(no_gap);
  EXPECT_GT(*std::max_element(right.begin(), right.end()), 0.2);
  EXPECT_LT(*std::min_element(right.begin(), right.end()), -0.2);
}

TEST_F(SkillTest, GapVelocityChangesInSteps) {
  const auto skill = make(Task::kGap, 10.0);
  Eigen::Vector3d last = Eigen::Vector3d::Zero();
  for (int i = 0; i < 20; ++i) {
    const auto output = skill->plan(at(0.1 * i));
    EXPECT_LE((output.command.velocity_m_s - last).norm(), 0.2 + 1e-9) << "2 m/s^2 at 10 Hz";
    last = output.command.velocity_m_s;
  }
}

TEST_F(SkillTest, OutputsHaveTheMapAndWhatThePipelineSaid) {
  draw(100, 12);
  const auto dodge = make(Task::kDodge);
  const auto first = dodge->plan(at(0.0));
  EXPECT_TRUE(first.map.empty());
  EXPECT_TRUE(std::holds_alternative<std::monostate>(first.details)) << "there was no pair";
  const auto second = dodge->plan(at(0.05));
  EXPECT_EQ(cv::norm(second.map, map, cv::NORM_INF), 0.0);
  EXPECT_EQ(second.status, to_string(std::get<tasks::DodgeResult>(second.details).status));

  const auto navigate = make(Task::kNavigate);
  SkillInput blind = at(0.0);
  blind.attitude.reset();
  navigate->plan(blind);
  blind.captured_s = 0.1;
  EXPECT_TRUE(std::holds_alternative<tasks::NavigateResult>(navigate->plan(blind).details));
  EXPECT_TRUE(std::holds_alternative<std::monostate>(navigate->plan(at(0.2)).details))
      << "with attitude and velocity a corridor is chosen, not a free space";

  SkillOptions few;
  few.task = Task::kGap;
  few.settle_s = few.first_look_s = 0.0;
  few.fewest_pairs = 1;
  const auto gap = make_skill(few, signal());
  EXPECT_EQ(std::get<tasks::GapResult>(gap->plan(at(0.0)).details).pairs, 0);
  const auto looked = gap->plan(at(0.05));
  EXPECT_EQ(std::get<tasks::GapResult>(looked.details).pairs, 1);
  EXPECT_FALSE(looked.map.empty());
}

TEST(SkillOptions, OutOfRangeIsNamed) {
  const auto refused = [](auto change, const char* name) {
    SkillOptions options;
    change(options);
    try {
      validate(options);
      ADD_FAILURE() << name;
    } catch (const Error& error) {
      EXPECT_NE(std::string(error.what()).find(name), std::string::npos) << error.what();
    }
  };
  EXPECT_NO_THROW(validate({}));
  refused([](SkillOptions& o) { o.horizontal_fov_rad = 0.0; }, "horizontal_fov_rad");
  refused([](SkillOptions& o) { o.planning_rate_hz = std::nan(""); }, "planning_rate_hz");
  refused([](SkillOptions& o) { o.last_look_s = 0.1; }, "last_look_s");
  refused([](SkillOptions& o) { o.dodge.gate = 0.0; }, "gate");
  refused([](SkillOptions& o) { o.gap_policy.realign = 0.0; }, "realign");
  EXPECT_THROW(make_skill({}, nullptr), Error);
  EXPECT_THROW(network_signal(nullptr, 0.0), Error);
}

TEST(NetworkSignal, TakesTurningOutOfThePair) {
  // A picture, and the same seen by a camera that has turned to the right: derotated, both are equal.
  const double fov = 1.2;
  const double turn = 0.05;
  cv::Mat texture(kHeight, kWidth, CV_8UC3);
  cv::randu(texture, cv::Scalar::all(0), cv::Scalar::all(255));
  cv::GaussianBlur(texture, texture, {}, 3.0);
  cv::normalize(texture, texture, 0, 255, cv::NORM_MINMAX);
  const double focal = 0.5 * kWidth / std::tan(0.5 * fov);
  const cv::Matx33d k(focal, 0, 0.5 * (kWidth - 1), 0, focal, 0.5 * (kHeight - 1), 0, 0, 1);
  const cv::Matx33d turned(std::cos(turn), 0, std::sin(turn), 0, 1, 0, -std::sin(turn), 0, std::cos(turn));
  cv::Mat second;
  cv::warpPerspective(texture, second, k * turned * k.inv(), texture.size(), cv::INTER_LINEAR | cv::WARP_INVERSE_MAP);
  const auto snapshot = [](const cv::Mat& image, double yaw_rad) {
    Snapshot result;
    result.image = Image(kWidth, kHeight);
    std::copy(image.data, image.data + result.image.size_bytes(), result.image.data());
    result.attitude = Attitude{Attitude::level(), yaw_rad};
    return result;
  };
  const InferFunction difference = [](const ImageView& a, const ImageView& b, FlowField& field, double) {
    field.width = a.width;
    field.height = a.height;
    const auto size = static_cast<std::size_t>(a.width) * static_cast<std::size_t>(a.height);
    field.flow.assign(2 * size, 0.0F);
    field.expected_error.assign(2 * size, 0.0F);
    field.uncertainty.assign(2 * size, 0.0F);
    for (std::size_t i = 0; i < size; ++i) {
      const auto x = static_cast<std::ptrdiff_t>(i % static_cast<std::size_t>(a.width));
      const auto y = static_cast<std::ptrdiff_t>(i / static_cast<std::size_t>(a.width));
      field.uncertainty[2 * i] =
          static_cast<float>(std::abs(a.data[y * a.row_stride + 3 * x] - b.data[y * b.row_stride + 3 * x]));
    }
  };
  const Signal signal = network_signal(difference, fov);
  const Snapshot first = snapshot(texture, 0.0);
  const Snapshot later = snapshot(second, turn);
  const double as_it_is = cv::mean(signal(first, later, CommonMotion::kNone).map)[0];
  const double derotated = cv::mean(signal(first, later, CommonMotion::kRotation).map)[0];
  EXPECT_GT(as_it_is, 15.0);
  EXPECT_LT(derotated, 0.25 * as_it_is);
  Snapshot unknown = later;
  unknown.attitude.reset();
  EXPECT_NEAR(cv::mean(signal(first, unknown, CommonMotion::kRotation).map)[0], as_it_is, 1e-6)
      << "without attitudes the pair is taken as it is";
}

}  // namespace
}  // namespace ajna::skills
