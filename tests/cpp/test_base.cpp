// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "ajna/base/conformal.hpp"
#include "ajna/base/error.hpp"
#include "ajna/base/flow_field.hpp"
#include "ajna/base/image_view.hpp"

namespace ajna {
namespace {

TEST(Error, NearestNameFindsTyposAndOnlyTypos) {
  const std::vector<std::string> known = {"softplus", "log", "log_square"};
  EXPECT_EQ(nearest_name("sofplus", known), "softplus");
  EXPECT_EQ(nearest_name("log_sqare", known), "log_square");
  EXPECT_EQ(nearest_name("tanh_of_x", known), "");
}

TEST(Error, UnknownNamesTheNearestAndAll) {
  try {
    throw_unknown("loss term g", "sofplus", {"log", "softplus"});
    FAIL() << "did not throw";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    EXPECT_STREQ(error.what(), "unknown loss term g 'sofplus', did you mean 'softplus'? Known: log, softplus");
  }
}

TEST(Image, IsBlackAndTightlyPacked) {
  const Image image(5, 3);
  EXPECT_EQ(image.size_bytes(), 45U);
  EXPECT_EQ(image.view().row_stride, 15);
  EXPECT_THROW(Image(0, 3), Error);
  EXPECT_TRUE(ImageView{}.empty());
}

TEST(FlowField, SummaryMatchesClosedForm) {
  FlowField field;
  field.width = 2;
  field.height = 1;
  field.flow = {3, 4, 0, 0};
  field.uncertainty = {1, 0, 0, 2};
  field.expected_error = {0, 1, 6, 8};
  const auto norm = uncertainty_norm(field);
  EXPECT_FLOAT_EQ(norm[0], 1.0F);
  EXPECT_FLOAT_EQ(norm[1], 2.0F);
  const auto summary = summarize(field);
  EXPECT_DOUBLE_EQ(summary.mean_flow_px, 2.5);
  EXPECT_DOUBLE_EQ(summary.max_flow_px, 5.0);
  EXPECT_DOUBLE_EQ(summary.mean_uncertainty, 1.5);
  EXPECT_DOUBLE_EQ(summary.mean_expected_error_px, 5.5);
}

std::string message_of(const std::function<void()>& action) {
  try {
    action();
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    return error.what();
  }
  return "nothing was thrown";
}

TEST(FlowField, IntervalReachesByFactorTimesExpectedError) {
  FlowField field;
  field.width = 2;
  field.height = 1;
  field.flow = {3, 4, 0, -1};
  field.uncertainty = {1, 1, 1, 1};
  field.expected_error = {0.5F, 1, 2, 0};
  EXPECT_NE(message_of([&] { (void)field.interval(0.9); }).find("ajna calibrate"), std::string::npos);
  field.conformal = std::make_shared<const ConformalFactors>(ConformalFactors{{0.5, 0.9}, {{1, 2}, {3, 2.5}}});
  const auto half = field.interval(0.5), nine = field.interval(0.9), between = field.interval(0.7);
  EXPECT_EQ(half.low, (std::vector<float>{2.5F, 2, -2, -1}));
  EXPECT_EQ(half.high, (std::vector<float>{3.5F, 6, 2, -1}));
  EXPECT_EQ(nine.high, (std::vector<float>{4.5F, 6.5F, 6, -1}));
  EXPECT_FLOAT_EQ(between.high[0], 4.0F);
  EXPECT_FLOAT_EQ(between.low[1], 1.75F);
  for (const double p : {0.49, 0.91, 0.0, 1.0, std::nan("")}) {
    const std::string message = message_of([&] { (void)field.interval(p); });
    EXPECT_NE(message.find("from 0.5 to 0.9"), std::string::npos) << message;
    EXPECT_NE(message.find("--levels"), std::string::npos) << message;
  }
}

TEST(ConformalFactors, CheckNamesWhatIsWrong) {
  const auto wrong = [](std::vector<double> levels, std::vector<std::array<double, 2>> factors) {
    const ConformalFactors made{std::move(levels), std::move(factors)};
    return message_of([&] { made.check(); });
  };
  EXPECT_NO_THROW((ConformalFactors{{0.5}, {{0, 1}}}.check()));
  EXPECT_NE(wrong({}, {}).find("at least one level"), std::string::npos);
  EXPECT_NE(wrong({0.5}, {}).find("1 interval levels and 0 pairs"), std::string::npos);
  EXPECT_NE(wrong({0.5, 0.5}, {{1, 1}, {1, 1}}).find("level 1 is 0.5"), std::string::npos);
  EXPECT_NE(wrong({1.0}, {{1, 1}}).find("inside (0, 1)"), std::string::npos);
  EXPECT_NE(wrong({0.5}, {{1, -1}}).find("factor of level 0.5 is -1"), std::string::npos);
  EXPECT_NE(wrong({0.5}, {{std::nan(""), 1}}).find("nan"), std::string::npos);
  EXPECT_NE(wrong({0.5, 0.6}, {{1, 2}, {2, 1}}).find("do not fall"), std::string::npos);
}

}  // namespace
}  // namespace ajna
