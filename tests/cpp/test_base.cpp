// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>

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

}  // namespace
}  // namespace ajna
