// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "ajna/nn/uncertainty_table.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using ajna::testing::expect_error;
using ajna::testing::paper_table;

TEST(UncertaintyTable, IsExactAtKnotsAndLinearBetween) {
  const UncertaintyTable table{-1.0, 0.5, torch::tensor({0.F, 1.F, 4.F}), torch::tensor({2.F, 2.F, 3.F})};
  const auto [uncertainty, error] = table.evaluate(torch::tensor({-1.F, -0.75F, -0.5F, -0.25F, 0.F}));
  EXPECT_TRUE(uncertainty.equal(torch::tensor({0.F, 0.5F, 1.F, 2.5F, 4.F})));
  EXPECT_TRUE(error.equal(torch::tensor({2.F, 2.F, 2.F, 2.5F, 3.F})));
}

TEST(UncertaintyTable, IsFlatBelowAndStraightAbove) {
  const UncertaintyTable table{-1.0, 0.5, torch::tensor({0.F, 1.F, 4.F}), torch::tensor({2.F, 2.F, 3.F})};
  const auto [uncertainty, error] = table.evaluate(torch::tensor({-1e30F, -2.F, 0.5F, 10.F}));
  EXPECT_TRUE(uncertainty.equal(torch::tensor({0.F, 0.F, 7.F, 64.F})));
  EXPECT_TRUE(error.equal(torch::tensor({2.F, 2.F, 4.F, 23.F})));
}

TEST(UncertaintyTable, FollowsTheCurveItSamples) {
  const auto raw = torch::rand({2, 2, 17, 23}) * 60 - 15;
  const auto [uncertainty, error] = paper_table().evaluate(raw);
  const auto exact = torch::softplus(raw.to(torch::kFloat64));
  EXPECT_EQ(uncertainty.sizes(), raw.sizes());
  EXPECT_LT((uncertainty - exact).abs().max().item<double>(), 2e-4);
  EXPECT_LT(((error - exact.square()).abs() / (1 + exact.square())).max().item<double>(), 1e-3);
}

TEST(UncertaintyTable, KeepsNanAndStandsInfinity) {
  const float nan = std::numeric_limits<float>::quiet_NaN(), inf = std::numeric_limits<float>::infinity();
  const auto [uncertainty, error] = paper_table().evaluate(torch::tensor({nan, inf, -inf, 1e38F}));
  EXPECT_TRUE(std::isnan(uncertainty[0].item<float>()));
  EXPECT_TRUE(std::isnan(error[0].item<float>()));
  EXPECT_EQ(uncertainty[1].item<float>(), inf);
  EXPECT_LT(uncertainty[2].item<float>(), 1e-6F);
  EXPECT_GT(error[3].item<float>(), 1e30F);
}

TEST(UncertaintyTable, RisesWithRaw) {
  const auto raw = std::get<0>((torch::randn({4000}) * 40).sort());
  const auto [uncertainty, error] = paper_table().evaluate(raw);
  EXPECT_GE(uncertainty.diff().min().item<float>(), 0.F);
  EXPECT_GE(error.diff().min().item<float>(), 0.F);
}

TEST(UncertaintyTable, HalfPrecisionRawIsWidened) {
  const auto raw = torch::tensor({1.5F, 3.F});
  const auto [uncertainty, error] = paper_table().evaluate(raw.to(torch::kBFloat16));
  EXPECT_EQ(uncertainty.scalar_type(), torch::kFloat32);
  EXPECT_TRUE(uncertainty.equal(paper_table().evaluate(raw).uncertainty));
  EXPECT_EQ(error.scalar_type(), torch::kFloat32);
}

TEST(UncertaintyTable, CheckNamesWhatIsWrong) {
  paper_table().check();
  const auto refused = [](const std::string& part, const auto& change) {
    UncertaintyTable table = paper_table();
    change(table);
    expect_error(ErrorKind::kInvalidArgument, part, [&] { table.check(); });
  };
  refused("steps of 0", [](auto& t) { t.raw_step = 0; });
  refused("steps of nan", [](auto& t) { t.raw_step = std::nan(""); });
  refused("raw inf", [](auto& t) { t.raw_min = std::numeric_limits<double>::infinity(); });
  refused("'uncertainty' is missing", [](auto& t) { t.uncertainty = torch::Tensor(); });
  refused("float32", [](auto& t) { t.expected_error = t.expected_error.to(torch::kFloat64); });
  refused("1 knots", [](auto& t) { t.uncertainty = torch::zeros({1}); });
  refused("same knots", [](auto& t) { t.uncertainty = torch::zeros({5}); });
  refused("at knot 3", [](auto& t) { t.uncertainty = t.uncertainty.clone(), t.uncertainty[3] = std::nanf(""); });
  refused("falls", [](auto& t) { t.expected_error = t.expected_error.flip(0); });
  refused("not negative", [](auto& t) { t.expected_error = t.expected_error - 1; });
}

}  // namespace
}  // namespace ajna::nn
