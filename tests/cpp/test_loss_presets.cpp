// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "ajna/loss/admissibility.hpp"
#include "ajna/loss/presets.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

std::vector<std::string> names() {
  std::vector<std::string> result;
  for (const auto& entry : presets()) result.push_back(entry.name);
  return result;
}

class EveryPreset : public testing::TestWithParam<std::string> {};

TEST_P(EveryPreset, HasTheGradientOfItsValue) {
  const UncertaintyLoss loss(preset(GetParam()).config);
  torch::manual_seed(4);
  const auto options = torch::TensorOptions().dtype(torch::kFloat64);
  const auto target = torch::randn({2, 3, 1, 2}, options);
  const auto p0 = target + 0.4 + torch::rand({2, 3, 1, 2}, options);  // no error at 0, where |x| has a kink
  const auto r0 = 0.3 + 2.0 * torch::rand({2, 1, 1, 2}, options);     // a > 0, also where raw itself is a
  const auto p = p0.clone().requires_grad_(true), r = r0.clone().requires_grad_(true);
  loss(p, r, target).backward();
  constexpr double kStep = 1e-6;
  const auto compare = [&](const Tensor& x0, const Tensor& grad, const auto& value) {
    for (std::int64_t i = 0; i < x0.numel(); ++i) {
      auto step = torch::zeros_like(x0);
      step.view(-1)[i] = kStep;
      const double slope = ((value(x0 + step) - value(x0 - step)) / (2 * kStep)).template item<double>();
      EXPECT_NEAR(grad.view(-1)[i].template item<double>(), slope, 1e-7 * (1 + std::abs(slope))) << loss.describe();
    }
  };
  compare(p0, p.grad(), [&](const Tensor& x) { return loss(x, r0, target); });
  compare(r0, r.grad(), [&](const Tensor& x) { return loss(p0, x, target); });
}

TEST_P(EveryPreset, StaysFiniteForExtremeRawInEveryPrecision) {
  const UncertaintyLoss loss(preset(GetParam()).config);
  for (const auto dtype : {torch::kFloat32, torch::kHalf, torch::kBFloat16}) {
    const auto raw = torch::tensor({-1e4, -100.0, -10.0, 0.5, 10.0, 100.0, 1e4}).view({1, 1, 1, -1});
    const auto r = raw.to(dtype).requires_grad_(true);
    const auto p = torch::full({1, 3, 1, 7}, 0.8).to(dtype).requires_grad_(true);
    const auto target = torch::tensor({0.3F, 0.1F, 0.5F}).view({1, 3, 1, 1}).expand({1, 3, 1, 7});
    const auto value = loss(p, r, target);
    value.backward();
    EXPECT_EQ(value.scalar_type(), torch::kFloat32);
    EXPECT_TRUE(std::isfinite(value.item<double>())) << c10::toString(dtype);
    EXPECT_TRUE(r.grad().isfinite().all().item<bool>()) << c10::toString(dtype) << r.grad();
    EXPECT_TRUE(p.grad().isfinite().all().item<bool>()) << c10::toString(dtype) << p.grad();
    if (check(loss).admissible) {
      // Whatever the error, raw far below its domain is pulled up, and far above it down.
      EXPECT_LT(r.grad().view(-1)[0].item<float>(), 0.0F) << c10::toString(dtype) << r.grad();
      EXPECT_GE(r.grad().view(-1)[6].item<float>(), 0.0F) << c10::toString(dtype) << r.grad();
    }
  }
}

INSTANTIATE_TEST_SUITE_P(TableThree, EveryPreset, testing::ValuesIn(names()),
                         [](const auto& item) { return item.param; });

}  // namespace
}  // namespace ajna::loss
