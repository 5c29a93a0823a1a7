// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/loss/uncertainty_loss.hpp"
#include "loss_fixtures.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

double softplus(double x) { return x > 30 ? x : std::log1p(std::exp(x)); }
double sigmoid(double x) { return 1.0 / (1.0 + std::exp(-x)); }

Tensor map_of(std::initializer_list<double> values) {
  return torch::tensor(std::vector<double>(values), kDouble).view({1, 1, 1, -1});
}

TEST(UncertaintyLoss, DefaultIsThePapersEquationOne) {
  const UncertaintyLoss loss;
  const std::vector<double> raws = {-5.0, -0.7, 0.0, 1.3, 20.0}, errors = {0.0, 0.2, 1.0, 3.0, 50.0};
  for (const double raw : raws) {
    for (const double error : errors) {
      const auto value = loss(map_of({error}), map_of({raw}), map_of({0.0})).item<double>();
      EXPECT_NEAR(value, error / softplus(raw + 1e-3) + softplus(raw), 1e-9 * (1 + value));
    }
  }
  EXPECT_EQ(loss.describe(), "f=l1 h=inv_softplus(eps=0.001) g=softplus lam=1 parametrization=none");
}

TEST(UncertaintyLoss, TermsHaveTheirClosedForms) {
  const double error = -1.7, raw = 0.8, sp = softplus(raw);
  const auto value = [&](const LossConfig& config) {
    return UncertaintyLoss(config)(map_of({error}), map_of({raw}), map_of({0.0})).item<double>();
  };
  EXPECT_NEAR(value(config_of({"l1"}, {"inv"}, {"log"})), 1.7 / raw + std::log(raw), 1e-12);
  EXPECT_NEAR(value(config_of({"squared_error"}, {"inv_square"}, {"log_square"})),
              1.7 * 1.7 / (raw * raw) + std::log(raw * raw), 1e-12);
  EXPECT_NEAR(value(config_of({"l1"}, {"inv"}, {"log"}, {"softplus"}, 0.2)), 1.7 / sp + 0.2 * std::log(sp), 1e-12);
  EXPECT_NEAR(value(config_of({"l1"}, {"inv_square"}, {"log"}, {"exp"})), 1.7 * std::exp(-2 * raw) + raw, 1e-12);
  EXPECT_NEAR(value(config_of({"charbonnier", {{"eps", 0.1}}}, {"inv"}, {"log"})),
              (std::sqrt(1.7 * 1.7 + 0.01) - 0.1) / raw + std::log(raw), 1e-12);
  EXPECT_NEAR(value(config_of({"l1"}, {"inv_softplus", {{"eps", 0.5}}}, {"softplus"})), 1.7 / softplus(raw + 0.5) + sp,
              1e-12);
}

TEST(UncertaintyLoss, ReductionsAgree) {
  const UncertaintyLoss loss;
  torch::manual_seed(1);
  const auto p = torch::randn({2, 2, 3, 4}, kDouble), r = torch::randn({2, 2, 3, 4}, kDouble), t = torch::zeros_like(p);
  const auto each = loss(p, r, t, std::nullopt, std::nullopt, Reduction::kNone);
  EXPECT_EQ(each.sizes(), p.sizes());
  EXPECT_NEAR(loss(p, r, t).item<double>(), each.mean().item<double>(), 1e-12);
  EXPECT_NEAR(loss(p, r, t, std::nullopt, std::nullopt, Reduction::kSum).item<double>(), each.sum().item<double>(),
              1e-10);
  const auto weight = torch::rand({2, 1, 3, 4}, kDouble);
  const auto weighted = (each * weight).sum() / weight.expand_as(each).sum();
  EXPECT_NEAR(loss(p, r, t, std::nullopt, weight).item<double>(), weighted.item<double>(), 1e-12);
  EXPECT_NEAR(loss(p, r, t, std::nullopt, weight.squeeze(1)).item<double>(), weighted.item<double>(), 1e-12);
}

TEST(UncertaintyLoss, OneRawChannelIsSharedByTheAxes) {
  const UncertaintyLoss loss;
  const auto p = torch::randn({2, 2, 3, 4}, kDouble), r = torch::randn({2, 1, 3, 4}, kDouble), t = torch::zeros_like(p);
  EXPECT_NEAR(loss(p, r, t).item<double>(), loss(p, r.expand_as(p), t).item<double>(), 1e-12);
}

/// Every f, and every h and g under every raw -> a.
std::vector<LossConfig> all_combinations() {
  std::vector<LossConfig> result;
  for (const auto& f : error_term_names()) {
    result.push_back(config_of({f}, {"inv"}, {"log"}, {"none"}, 0.7));
  }
  for (const auto& parametrization : parametrization_names()) {
    for (const auto& h : attenuation_names()) {
      result.push_back(config_of({"l1"}, {h}, {"log"}, {parametrization}, 0.7));
    }
    for (const auto& g : penalty_names()) {
      result.push_back(config_of({"l1"}, {"inv"}, {g}, {parametrization}, 0.7));
    }
  }
  return result;
}

TEST(UncertaintyLoss, GradientsAgreeWithFiniteDifferences) {
  // a > 0 throughout, as 1/a and log a demand, and no error at 0, where |x| has a kink.
  const auto p0 = map_of({1.5, -0.4, 3.0, -2.2}), r0 = map_of({0.6, 1.1, 2.4, 0.9}), t = map_of({0.1, 0.3, -0.5, 0.4});
  constexpr double kStep = 1e-6;
  for (const auto& config : all_combinations()) {
    const UncertaintyLoss loss(config);
    const auto p = p0.clone().requires_grad_(true), r = r0.clone().requires_grad_(true);
    loss(p, r, t).backward();
    for (std::int64_t i = 0; i < p0.numel(); ++i) {
      auto step = torch::zeros_like(p0);
      step.view(-1)[i] = kStep;
      const auto slope = [&](const Tensor& dp, const Tensor& dr) {
        return ((loss(p0 + dp, r0 + dr, t) - loss(p0 - dp, r0 - dr, t)) / (2 * kStep)).item<double>();
      };
      const auto zero = torch::zeros_like(p0);
      EXPECT_NEAR(p.grad().view(-1)[i].item<double>(), slope(step, zero), 1e-7) << loss.describe();
      EXPECT_NEAR(r.grad().view(-1)[i].item<double>(), slope(zero, step), 1e-7) << loss.describe();
    }
  }
}

TEST(UncertaintyLoss, GradientsAgreeAcrossTheLowerContinuation) {
  const UncertaintyLoss loss;
  const auto t = map_of({0.0, 0.0, 0.0}), p = map_of({0.3, 0.3, 0.3});
  const auto r0 =
      map_of({UncertaintyLoss::kRawMin - 2.0, UncertaintyLoss::kRawMin - 1e-3, UncertaintyLoss::kRawMin + 1.0});
  const auto r = r0.clone().requires_grad_(true);
  const auto values = loss(p, r, t, std::nullopt, std::nullopt, Reduction::kNone);
  values.sum().backward();
  const double step = 1e-5;
  const auto slope = (loss(p, r0 + step, t, std::nullopt, std::nullopt, Reduction::kNone) -
                      loss(p, r0 - step, t, std::nullopt, std::nullopt, Reduction::kNone)) /
                     (2 * step);
  EXPECT_TRUE(torch::allclose(r.grad(), slope, 1e-5, 1e-5)) << r.grad() << slope;
  EXPECT_TRUE((r.grad() < 0).all().item<bool>()) << "raw must be pulled back up where the error is above zero";
}

class ExtremeRaw : public testing::TestWithParam<torch::ScalarType> {};

void expect_finite(const UncertaintyLoss& loss, torch::ScalarType dtype) {
  const auto values = torch::tensor({-1e4, -100.0, -20.0, -10.0, 0.0, 10.0, 100.0, 1e4}).view({1, 1, 1, -1});
  const auto r = values.to(dtype).requires_grad_(true);
  for (const double error : {0.0, 1e-3, 1.0, 1e3}) {
    const auto p = torch::full_like(values, error).to(dtype).requires_grad_(true);
    const auto value = loss(p, r, torch::zeros_like(p));
    EXPECT_EQ(value.scalar_type(), torch::kFloat32);
    EXPECT_TRUE(std::isfinite(value.item<double>())) << loss.describe();
    value.backward();
    EXPECT_TRUE(r.grad().isfinite().all().item<bool>()) << "error " << error << r.grad();
    EXPECT_TRUE(p.grad().isfinite().all().item<bool>()) << "error " << error << p.grad();
    r.mutable_grad() = Tensor();
  }
  EXPECT_TRUE(loss.uncertainty(r).isfinite().all().item<bool>());
  EXPECT_TRUE(loss.expected_error(r).isfinite().all().item<bool>());
}

TEST_P(ExtremeRaw, ValueAndGradientStayFinite) {
  for (const auto& config : {LossConfig{}, config_of({"l1"}, {"inv_square"}, {"log_square"}, {"exp"}),
                             config_of({"l1"}, {"inv"}, {"log"}, {"softplus"}),
                             config_of({"l1"}, {"identity"}, {"neg_log"}, {"confidence"})}) {
    expect_finite(UncertaintyLoss(config), GetParam());
  }
}

INSTANTIATE_TEST_SUITE_P(Precisions, ExtremeRaw, testing::Values(torch::kFloat32, torch::kHalf, torch::kBFloat16),
                         [](const auto& item) { return std::string(c10::toString(item.param)); });

class MaskedGarbage : public testing::TestWithParam<double> {};

TEST_P(MaskedGarbage, IsNeitherReadNorGivenAGradient) {
  const UncertaintyLoss loss;
  torch::manual_seed(2);
  const auto clean_p = torch::randn({1, 2, 2, 3}), clean_r = torch::randn({1, 2, 2, 3}),
             clean_t = torch::randn({1, 2, 2, 3});
  const auto mask = torch::tensor({1, 0, 1, 1, 1, 0}, torch::kBool).view({1, 1, 2, 3});
  const auto hidden = mask.logical_not().expand_as(clean_p);
  const auto expected = loss(clean_p, clean_r, clean_t, mask).item<float>();
  const auto dirty = [&](const Tensor& x) { return x.masked_fill(hidden, GetParam()).requires_grad_(true); };
  const auto p = dirty(clean_p), r = dirty(clean_r);
  const auto t = clean_t.masked_fill(hidden, GetParam());
  const auto weight = torch::ones({1, 1, 2, 3}).masked_fill(mask.logical_not(), GetParam());
  for (const auto& given : {mask, mask.squeeze(1), mask.to(torch::kFloat32), mask.expand_as(clean_p)}) {
    const auto value = loss(p, r, t, given, weight);
    EXPECT_FLOAT_EQ(value.item<float>(), expected);
    value.backward();
    for (const auto& grad : {p.grad(), r.grad()}) {
      EXPECT_TRUE(grad.isfinite().all().item<bool>());
      EXPECT_EQ(grad.masked_select(hidden).abs().sum().item<float>(), 0.0F);
      EXPECT_GT(grad.abs().sum().item<float>(), 0.0F);
    }
    p.mutable_grad() = r.mutable_grad() = Tensor();
    const auto each = loss(p, r, t, given, weight, Reduction::kNone);
    EXPECT_EQ(each.masked_select(hidden).abs().sum().item<float>(), 0.0F);
  }
}

INSTANTIATE_TEST_SUITE_P(Values, MaskedGarbage,
                         testing::Values(std::numeric_limits<double>::quiet_NaN(),
                                         std::numeric_limits<double>::infinity(),
                                         -std::numeric_limits<double>::infinity()),
                         [](const auto& item) {
                           return std::string(std::isnan(item.param) ? "NaN" : item.param > 0 ? "Inf" : "MinusInf");
                         });

TEST(UncertaintyLoss, MaskedPlacesAreLeftOutForEveryChoiceOfTerms) {
  const auto p0 = map_of({1.5, NAN, 3.0}), r0 = map_of({0.6, NAN, 2.4}), t = map_of({0.1, NAN, -0.5});
  const auto mask = torch::tensor({1, 0, 1}, torch::kBool).view({1, 1, 1, 3});
  for (const auto& config : all_combinations()) {
    const UncertaintyLoss loss(config);
    const auto p = p0.clone().requires_grad_(true), r = r0.clone().requires_grad_(true);
    const auto value = loss(p, r, t, mask);
    EXPECT_NEAR(value.item<double>(), loss(map_of({1.5, 3.0}), map_of({0.6, 2.4}), map_of({0.1, -0.5})).item<double>(),
                1e-12)
        << loss.describe();
    value.backward();
    for (const auto& grad : {p.grad(), r.grad()}) {
      EXPECT_TRUE(grad.isfinite().all().item<bool>()) << loss.describe();
      EXPECT_EQ(grad.view(-1)[1].item<double>(), 0.0) << loss.describe();
    }
  }
}

TEST(UncertaintyLoss, NoValidPixelGivesZeroAndZeroGradient) {
  const UncertaintyLoss loss;
  const auto p = torch::randn({1, 2, 2, 2}).requires_grad_(true), r = torch::randn({1, 2, 2, 2}).requires_grad_(true);
  const auto value = loss(p, r, torch::full({1, 2, 2, 2}, NAN), torch::zeros({1, 1, 2, 2}, torch::kBool));
  EXPECT_EQ(value.item<float>(), 0.0F);
  value.backward();
  EXPECT_EQ(p.grad().abs().sum().item<float>(), 0.0F);
  EXPECT_EQ(r.grad().abs().sum().item<float>(), 0.0F);
}

TEST(ExpectedError, OfThePapersLossHasItsClosedForm) {
  const UncertaintyLoss loss;
  const auto raw = torch::linspace(-9.0, 50.0, 60, kDouble);
  const auto kappa = loss.expected_error(raw);
  for (std::int64_t i = 0; i < raw.numel(); ++i) {
    const double a = raw[i].item<double>(), s = softplus(a + 1e-3);
    const double expected = s * s * sigmoid(a) / sigmoid(a + 1e-3);
    EXPECT_NEAR(kappa[i].item<double>(), expected, 1e-8 * expected);  // softplus is the identity from 20 on
  }
  EXPECT_TRUE((kappa.diff() > 0).all().item<bool>()) << "the choice must be admissible";
}

TEST(ExpectedError, OfTheClassicalLossesIsTheScaleOrTheVariance) {
  const auto a = torch::linspace(0.05, 12.0, 40, kDouble);
  const UncertaintyLoss laplace(config_of({"l1"}, {"inv"}, {"log"}, {"none"}, 0.3));
  EXPECT_TRUE(torch::allclose(laplace.expected_error(a), 0.3 * a));
  const UncertaintyLoss gauss(config_of({"squared_error"}, {"inv_square"}, {"log_square"}));
  EXPECT_TRUE(torch::allclose(gauss.expected_error(a), a * a));
  const UncertaintyLoss positive(config_of({"l1"}, {"inv"}, {"log"}, {"softplus"}));
  EXPECT_TRUE(torch::allclose(positive.expected_error(a - 6.0), torch::softplus(a - 6.0)));
  const UncertaintyLoss log_scale(config_of({"l1"}, {"inv"}, {"log"}, {"exp"}));
  EXPECT_TRUE(torch::allclose(log_scale.expected_error(a - 6.0), (a - 6.0).exp()));
}

TEST(ExpectedError, IsWhereTheLossIsLeast) {
  for (const double raw : {-3.0, 0.0, 1.5, 8.0}) {
    const UncertaintyLoss loss;
    const auto error = loss.expected_error(map_of({raw}));
    const auto at = [&](double r) { return loss(error, map_of({r}), map_of({0.0})).item<double>(); };
    EXPECT_LT(at(raw), at(raw + 0.05));
    EXPECT_LT(at(raw), at(raw - 0.05));
  }
}

TEST(UncertaintyLoss, WorksInInferenceMode) {
  const c10::InferenceMode inference;
  const UncertaintyLoss loss;
  const auto raw = torch::randn({1, 2, 3, 3});
  EXPECT_TRUE(std::isfinite(loss(torch::rand_like(raw), raw, torch::zeros_like(raw)).item<float>()));
  EXPECT_TRUE((loss.expected_error(raw) > 0).all().item<bool>());
  EXPECT_TRUE((loss.uncertainty(raw) > 0).all().item<bool>());
}

TEST(UncertaintyLoss, UnusableOptionsAreNamed) {
  const auto make = [](LossConfig config) { return [config] { const UncertaintyLoss loss(config); }; };
  auto config = LossConfig{};
  config.lam = 0.0;
  EXPECT_NE(message_of(make(config)).find("lam = 0"), std::string::npos);
  config.lam = NAN;
  EXPECT_NE(message_of(make(config)).find("lam"), std::string::npos);
  EXPECT_NE(message_of(make(config_of({"l3"}, {"inv"}, {"log"}))).find("'l3'"), std::string::npos);
  EXPECT_NE(message_of(make(config_of({"l1"}, {"inv_sofplus"}, {"log"}))).find("inv_softplus"), std::string::npos);
  EXPECT_NE(message_of(make(config_of({"l1"}, {"inv"}, {"lgo"}))).find("log"), std::string::npos);
  EXPECT_NE(message_of(make(config_of({"l1"}, {"inv"}, {"log"}, {"expo"}))).find("exp"), std::string::npos);
  EXPECT_NE(message_of(make(config_of({"l1", {{"eps", 1.0}}}, {"inv"}, {"log"}))).find("no parameters"),
            std::string::npos);
  EXPECT_NE(message_of(make(config_of({"charbonnier", {{"esp", 1.0}}}, {"inv"}, {"log"}))).find("eps"),
            std::string::npos);
  EXPECT_NE(message_of(make(config_of({"charbonnier", {{"eps", NAN}}}, {"inv"}, {"log"}))).find("not finite"),
            std::string::npos);
  EXPECT_NE(message_of([] { parse_reduction("average"); }).find("average"), std::string::npos);
}

TEST(UncertaintyLoss, ShapesThatDoNotFitAreNamed) {
  const UncertaintyLoss loss;
  const auto p = torch::zeros({2, 2, 3, 4});
  EXPECT_NE(message_of([&] { (void)loss(p, p, torch::zeros({2, 2, 3, 5})); }).find("[2, 2, 3, 5]"), std::string::npos);
  EXPECT_NE(message_of([&] { (void)loss(p, torch::zeros({2, 3, 3, 4}), p); }).find("raw"), std::string::npos);
  EXPECT_NE(message_of([&] { (void)loss(p, p, p, torch::ones({3, 4})); }).find("mask"), std::string::npos);
  EXPECT_NE(message_of([&] {
              (void)loss(p, p, p, std::nullopt, torch::ones({2, 1, 3, 5}));
            }).find("weight"),
            std::string::npos);
}

}  // namespace
}  // namespace ajna::loss
