// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/loss/admissibility.hpp"
#include "ajna/loss/expression.hpp"
#include "ajna/loss/likelihood.hpp"
#include "ajna/loss/presets.hpp"
#include "loss_fixtures.hpp"

namespace ajna::loss {
namespace {

using torch::Tensor;

/// Largest difference between an analytic and a central finite difference gradient of y(x).
template <class Function>
double gradient_miss(const Function& function, const Tensor& x0) {
  constexpr double kStep = 1e-6;
  const auto x = x0.clone().requires_grad_(true);
  function(x).sum().backward();
  double miss = 0.0;
  for (std::int64_t i = 0; i < x0.numel(); ++i) {
    auto step = torch::zeros_like(x0);
    step.view(-1)[i] = kStep;
    const double slope = ((function(x0 + step) - function(x0 - step)).sum() / (2 * kStep)).template item<double>();
    miss = std::max(miss, std::abs(slope - x.grad().view(-1)[i].template item<double>()));
  }
  return miss;
}

TEST(Terms, EveryErrorTermHasTheGradientOfItsValue) {
  torch::manual_seed(1);
  const auto p = torch::randn({2, 3, 2, 2}, kDouble) + 0.2, t = torch::softmax(torch::randn({2, 3, 2, 2}, kDouble), 1);
  for (const auto& name : error_term_names()) {
    const auto f = make_error_term({name});
    EXPECT_LT(gradient_miss([&](const Tensor& x) { return f.value(x, t); }, p), 1e-7) << name;
    EXPECT_LT(gradient_miss([&](const Tensor& x) { return f.value(p, x); }, t), 1e-7) << name;
    EXPECT_GE(f.value(p, t).min().item<double>(), 0.0) << name;
  }
}

TEST(Terms, EveryScalarTermHasTheSlopeOfItsValue) {
  const auto a = torch::tensor({0.05, 0.4, 0.9, 1.7, 6.0, 25.0}, kDouble);
  const auto raw = torch::tensor({-9.0, -1.0, 0.0, 0.7, 6.0, 33.0}, kDouble);
  const auto check_term = [&](const ScalarTerm& term, const Tensor& x0) {
    const auto x = x0.clone().requires_grad_(true);
    term.value(x).sum().backward();
    EXPECT_TRUE(torch::allclose(x.grad(), term.slope(x0), 1e-6, 1e-12)) << term.name << x.grad() << term.slope(x0);
    const double step = 1e-6;
    const auto difference = (term.value(x0 + step) - term.value(x0 - step)) / (2 * step);
    EXPECT_TRUE(torch::allclose(difference, term.slope(x0), 1e-4, 1e-7)) << term.name;
  };
  for (const auto& name : attenuation_names()) check_term(make_attenuation({name}), a);
  for (const auto& name : penalty_names()) check_term(make_penalty({name}), a);
  for (const auto& name : parametrization_names()) check_term(make_parametrization({name}), raw);
}

TEST(Terms, ErrorTermsHaveTheirClosedForms) {
  const auto p = torch::tensor({3.0, 0.0}, kDouble).view({1, 2, 1, 1}),
             t = torch::tensor({0.0, -4.0}, kDouble).view({1, 2, 1, 1});
  const auto value = [&](const TermSpec& spec) { return make_error_term(spec).value(p, t).sum().item<double>(); };
  EXPECT_DOUBLE_EQ(value({"l1"}), 7.0);
  EXPECT_DOUBLE_EQ(value({"l2"}), 5.0);
  EXPECT_DOUBLE_EQ(value({"squared_l2"}), 25.0);
  EXPECT_DOUBLE_EQ(value({"smooth_l1", {{"beta", 2.0}}}), 7.0 - 2.0);
  EXPECT_DOUBLE_EQ(value({"huber", {{"delta", 2.0}}}), 2.0 * (3.0 - 1.0) + 2.0 * (4.0 - 1.0));
  EXPECT_DOUBLE_EQ(value({"huber", {{"delta", 10.0}}}), 0.5 * 25.0);
  EXPECT_NEAR(value({"angular"}), std::acos(0.0), 1e-15);
}

TEST(Terms, TheAngleIsAccurateAtItsEnds) {
  const auto f = make_error_term({"angular"});
  for (const double angle : {0.0, 1e-9, 1e-4, 3.141592653589793 - 1e-6}) {
    const auto p =
        torch::tensor({std::cos(angle), std::sin(angle), 0.0}, kDouble).view({1, 3, 1, 1}).requires_grad_(true);
    const auto t = torch::tensor({2.0, 0.0, 0.0}, kDouble).view({1, 3, 1, 1});
    const auto value = f.value(p, t);
    EXPECT_NEAR(value.item<double>(), angle, 1e-12);
    value.sum().backward();
    EXPECT_TRUE(p.grad().isfinite().all().item<bool>());
  }
}

TEST(Terms, UnknownNamesAndParametersSuggestTheNearest) {
  EXPECT_NE(message_of([] { make_error_term({"smoth_l1"}); }).find("smooth_l1"), std::string::npos);
  EXPECT_NE(message_of([] { make_parametrization({"exp", {{"scal", 2.0}}}); }).find("scale"), std::string::npos);
  EXPECT_NE(message_of([] { make_error_term({"huber", {{"delta", -1.0}}}); }).find("above 0"), std::string::npos);
}

TEST(Expression, EqualsTheRegisteredTerm) {
  const auto own = config_of({"abs(prediction - target)"}, {"1 / log(1 + exp(a + eps))", {{"eps", 1e-3}}},
                             {"log(1 + exp(a))"}, {"none"});
  const UncertaintyLoss mine(own), registered;
  torch::manual_seed(3);
  const auto t = torch::randn({1, 2, 3, 4}, kDouble);
  const auto p = torch::randn({1, 2, 3, 4}, kDouble).requires_grad_(true), q = p.detach().clone().requires_grad_(true);
  const auto r = (4 * torch::randn({1, 2, 3, 4}, kDouble)).requires_grad_(true),
             s = r.detach().clone().requires_grad_(true);
  const auto a = mine(p, r, t), b = registered(q, s, t);
  EXPECT_NEAR(a.item<double>(), b.item<double>(), 1e-12 * std::abs(b.item<double>()));
  a.backward();
  b.backward();
  EXPECT_TRUE(torch::allclose(p.grad(), q.grad(), 1e-9));
  EXPECT_TRUE(torch::allclose(r.grad(), s.grad(), 1e-9));
  EXPECT_TRUE(torch::allclose(mine.expected_error(r), registered.expected_error(r), 1e-6));
}

TEST(Expression, EvaluatesLikeArithmetic) {
  const auto value = [](const std::string& text, double a) {
    return Expression("h", text, {"a"}, {{"k", 3.0}})({torch::tensor({a}, kDouble)}).item<double>();
  };
  EXPECT_DOUBLE_EQ(value("1 / 2 * a", 3.0), 1.5);
  EXPECT_DOUBLE_EQ(value("-a ** 2", 3.0), -9.0);
  EXPECT_DOUBLE_EQ(value("2 ** 3 ** 2 + 0 * a", 3.0), 512.0);
  EXPECT_DOUBLE_EQ(value("2 ** -a", 2.0), 0.25);
  EXPECT_DOUBLE_EQ(value("k - a - 1", 1.0), 1.0);
  EXPECT_DOUBLE_EQ(value("clamp(a, -1, 1) + maximum(a, 5) + 1.5e0", 3.0), 7.5);
  EXPECT_DOUBLE_EQ(value("log(2) * a", 1.0), std::log(2.0));
  EXPECT_NEAR(value("softplus(a)", 1.0), std::log1p(std::exp(1.0)), 1e-15);
  for (const auto& name : expression_functions()) {
    if (name == "norm" || name == "sum") continue;  // for f alone
    const std::string rest = name == "clamp" ? ", 0, 1" : name == "maximum" || name == "minimum" ? ", 2" : "";
    EXPECT_TRUE(std::isfinite(value(name + "(a" + rest + ")", 0.5))) << name;
  }
}

TEST(Expression, FaultsAreNamedWithTheirPlace) {
  const auto fault = [](const std::string& text) { return message_of([&] { make_attenuation({text}); }); };
  EXPECT_NE(fault("1 / (a + 1").find("missing ')' at column 11"), std::string::npos) << fault("1 / (a + 1");
  EXPECT_NE(fault("1 / (b + 1)").find("unknown name at column 6"), std::string::npos) << fault("1 / (b + 1)");
  EXPECT_NE(fault("1 / loog(a)").find("did you mean 'log'"), std::string::npos);
  EXPECT_NE(fault("a.exp()").find("column 2"), std::string::npos);
  EXPECT_NE(fault("__import__('os')").find("column 1"), std::string::npos);
  EXPECT_NE(fault("a[0]").find("column 2"), std::string::npos);
  EXPECT_NE(fault("2 a").find("column 3"), std::string::npos);
  EXPECT_NE(fault("a + ").find("too early"), std::string::npos);
  EXPECT_NE(fault("1 + 2").find("does not use"), std::string::npos);
  EXPECT_NE(fault("1 / 0 + a").find("not finite"), std::string::npos);
  EXPECT_NE(fault("exp(a, 2)").find("takes 1 arguments"), std::string::npos);
  EXPECT_NE(fault(std::string(500, '(')).find("nested"), std::string::npos);
  EXPECT_NE(fault("sum(a) + a").find("channel axis"), std::string::npos);
  EXPECT_NE(message_of([] { make_error_term({"abs(prediction)"}); }).find("'target'"), std::string::npos);
  EXPECT_NE(message_of([] { make_error_term({"log(prediction - target)"}); }).find("not finite"), std::string::npos);
  EXPECT_NE(message_of([] { UncertaintyLoss(config_of({"l1"}, {"1 / a"}, {"log"}, {"none"})); }).find("a = 0"),
            std::string::npos);
}

TEST(OwnFunction, WorksAndIsContinued) {
  auto config = config_of({"l1"}, {"mine"}, {"softplus"}, {"none"});
  config.h.function = [](const Tensor& a) { return (1.0 + a.exp()).log().reciprocal(); };
  const UncertaintyLoss loss(config);
  const auto raw = torch::tensor({-1e4, 0.3, 1e4}).requires_grad_(true);
  const auto value = loss(torch::ones({3}), raw, torch::zeros({3}));
  value.backward();
  EXPECT_TRUE(value.isfinite().item<bool>() && raw.grad().isfinite().all().item<bool>()) << raw.grad();
  EXPECT_GT(raw.grad()[2].item<double>(), 0.0) << "far above the domain the penalty must pull raw back";
  EXPECT_TRUE(check(loss).admissible) << check(loss).reason;
  config.h.function = [](const Tensor& a) { return a.detach(); };
  EXPECT_NE(message_of([&] { UncertaintyLoss{config}; }).find("differentiated"), std::string::npos);
}

TEST(Presets, EachHasTheExpectedErrorAndTheCheckThatItIsDocumentedWith) {
  int rows = 0;
  for (const auto& entry : presets()) {
    const UncertaintyLoss loss(entry.config);
    const auto report = check(loss);
    const bool printed = entry.name.find("_printed") != std::string::npos;
    EXPECT_EQ(report.admissible, !printed) << entry.name << ": " << report.reason;
    EXPECT_EQ(report.reason.empty(), !printed) << entry.name;
    rows += !printed && entry.reference != 0;
    const auto raw = torch::linspace(-4.0, 15.0, 39, kDouble) + 0.01;
    const auto curves = loss.curves(raw);
    const auto closed = loss.expected_error(raw), slopes = -entry.config.lam * curves.g_slope / curves.h_slope;
    if (entry.name == "feng2019_printed") continue;  // no kappa without an h
    EXPECT_TRUE(torch::allclose(closed, slopes, 1e-6, 1e-9)) << entry.name << closed << slopes;
  }
  EXPECT_EQ(rows, 17);
  EXPECT_NE(message_of([] { preset("kendal2017"); }).find("kendall2017"), std::string::npos);
}

TEST(Admissibility, SaysWhereAndWhyAPrintedFormFails) {
  const auto report = [](const char* name) { return check(UncertaintyLoss(preset(name).config)); };
  EXPECT_NE(report("zhou2017_printed").reason.find("h does not fall"), std::string::npos);
  EXPECT_NE(report("feng2019_printed").reason.find("h does not fall"), std::string::npos);
  EXPECT_NE(report("bae2021_printed").reason.find("h is not positive"), std::string::npos);
  const UncertaintyLoss singh(preset("singh2021_printed").config);
  EXPECT_TRUE(check(singh, 2.0, 10.0).admissible);
  const auto near_zero = check(singh, 1e-3, 2.0);
  EXPECT_FALSE(near_zero.admissible);
  EXPECT_NE(near_zero.reason.find("does not rise"), std::string::npos) << near_zero.reason;
  EXPECT_NE(message_of([&] { (void)check(singh, 2.0, 2.0); }).find("empty"), std::string::npos);
}

TEST(Likelihood, OfThePresetsIsTheKnownOne) {
  const auto factor = [](const char* name) {
    const auto found = Likelihood::of(UncertaintyLoss(preset(name).config));
    return found ? found->factor() : 0.0;
  };
  EXPECT_NEAR(factor("kendall2017"), 2.0, 1e-9);
  EXPECT_NEAR(factor("gast2018"), 2.0, 1e-9);
  EXPECT_NEAR(factor("ilg2018"), 0.5, 1e-9);
  EXPECT_EQ(factor("poggi2020"), 1.0);
  EXPECT_EQ(factor("li2021"), 1.0);
  EXPECT_EQ(factor("bae2021"), 1.0);
  EXPECT_NEAR(factor("zhou2017"), 0.2, 1e-9);
  EXPECT_EQ(factor("ajna2023"), 0.0);
  EXPECT_EQ(factor("feng2019"), 0.0);
  EXPECT_NE(message_of([] { Likelihood::require(UncertaintyLoss()); }).find("not the likelihood"), std::string::npos);
}

TEST(Likelihood, IntegratesToOneAndItsQuantilesInvertItsCdf) {
  for (const char* name : {"poggi2020", "kendall2017", "ilg2018", "bae2021"}) {
    const UncertaintyLoss loss(preset(name).config);
    const auto density = Likelihood::require(loss);
    const auto raw = torch::tensor({-2.0, 0.0, 1.5}, kDouble);
    for (const double p : {0.02, 0.5, 0.9}) {
      const auto share = torch::tensor(p, kDouble);
      EXPECT_TRUE(torch::allclose(density.cdf(density.quantile(share, raw), raw), share.expand({3}), 1e-7)) << name;
    }
    const auto [low, high] = density.interval(0.8, raw);
    EXPECT_TRUE(torch::allclose(density.cdf(high, raw) - density.cdf(low, raw), torch::full({3}, 0.8, kDouble)))
        << name;
    if (density.family() == Likelihood::Family::kAngular) continue;
    const auto x = torch::linspace(-200.0, 200.0, 400001, kDouble).view({-1, 1});
    const auto zero = torch::zeros_like(x);
    const auto mass =
        torch::trapezoid((-density.nll(x, torch::full_like(x, 1.5), zero)).exp().view({-1}), x.view({-1}));
    EXPECT_NEAR(mass.item<double>(), 1.0, 1e-4) << name;
  }
}

TEST(Likelihood, CrpsIsTheIntegralOfItsDefinition) {
  const auto x = torch::linspace(-100.0, 100.0, 400001, kDouble).view({-1, 1});
  for (const char* name : {"poggi2020", "kendall2017", "ilg2018", "martinbrualla2021"}) {
    const auto density = Likelihood::require(UncertaintyLoss(preset(name).config), 2);
    const auto raw = torch::tensor({-2.0, 0.0, 1.5, 1.5}, kDouble), zero = torch::zeros_like(raw);
    const auto error = torch::tensor({0.3, -1.0, 6.0, 0.0}, kDouble);
    const auto step = (x >= error).to(kDouble);
    const auto integral = torch::trapezoid((density.cdf(x, raw) - step).square(), x, 0);
    EXPECT_TRUE(torch::allclose(density.crps(zero, raw, error), integral, 1e-3, 1e-3)) << name;
  }
  const auto angular = Likelihood::require(UncertaintyLoss(preset("bae2021").config));
  const auto one = torch::ones({1, 3, 1, 1}, kDouble);
  EXPECT_NE(message_of([&] { (void)angular.crps(one, one, one); }).find("no closed form"), std::string::npos);
}

TEST(Likelihood, OfTheLengthOverChannelsIsTheSphericalLaplace) {
  const UncertaintyLoss single(config_of({"l2"}, {"inv"}, {"log"}, {"softplus"}));
  EXPECT_EQ(Likelihood::require(single).family(), Likelihood::Family::kLaplace);
  for (const std::int64_t d : {2, 3}) {
    auto config = config_of({"l2"}, {"inv"}, {"log"}, {"softplus"});
    config.lam = static_cast<double>(d);
    const auto density = Likelihood::require(UncertaintyLoss(config), d);
    EXPECT_EQ(density.family(), Likelihood::Family::kRadial);
    EXPECT_TRUE(density.is_normalised());
    const auto raw = torch::tensor({-1.0, 0.7}, kDouble).view({2, 1});
    // Mass: the density at radius r times the surface of the sphere of that radius.
    const auto r = torch::linspace(0.0, 80.0, 200001, kDouble);
    auto at = torch::zeros({r.size(0), d}, kDouble);
    at.select(1, 0).copy_(r);
    const double surface = d == 2 ? 2 * 3.14159265358979323846 : 4 * 3.14159265358979323846;
    const auto nll = density.nll(at, raw[1].expand({r.size(0), 1}), torch::zeros_like(at)).view({-1});
    const auto rate = (-nll).exp() * surface * r.pow(static_cast<double>(d - 1));
    EXPECT_NEAR(torch::trapezoid(rate, r).item<double>(), 1.0, 1e-4);
    const double below_two = torch::trapezoid(rate.slice(0, 0, 5001), r.slice(0, 0, 5001)).item<double>();
    EXPECT_NEAR(density.cdf(torch::tensor(2.0, kDouble), raw[1]).item<double>(), below_two, 1e-4);
    for (const double p : {0.02, 0.5, 0.99}) {
      const auto share = torch::tensor(p, kDouble);
      EXPECT_TRUE(torch::allclose(density.cdf(density.quantile(share, raw), raw), share.expand({2, 1}), 1e-7));
    }
    const auto [low, high] = density.interval(0.8, raw);
    EXPECT_EQ(low.abs().max().item<double>(), 0.0);
    EXPECT_NEAR(density.cdf(high, raw)[0].item<double>(), 0.8, 1e-7);
    EXPECT_NE(message_of([&] { (void)density.crps(raw, raw, raw); }).find("spherical Laplace"), std::string::npos);
    EXPECT_NE(message_of([&] {
                (void)density.nll(torch::zeros({1, d + 1}), torch::zeros({1, 1}), torch::zeros({1, d + 1}));
              }).find("pass channels="),
              std::string::npos);
  }
}

TEST(MultiScale, IsTheWeightedSumOfItsScales) {
  const UncertaintyLoss loss;
  torch::manual_seed(5);
  const auto target = torch::randn({2, 2, 8, 8}, kDouble);
  const auto scale = [](std::int64_t n) {
    return ScalePrediction{torch::randn({2, 2, n, n}, kDouble), torch::randn({2, 2, n, n}, kDouble)};
  };
  const auto fine = scale(8), coarse = scale(4);
  const auto half = torch::avg_pool2d(target, 2);
  const auto expected = loss(fine.prediction, fine.raw, target) + 0.3 * loss(coarse.prediction, coarse.raw, half);
  EXPECT_NEAR(multi_scale_loss(loss, {fine, coarse}, target, {1.0, 0.3}).item<double>(), expected.item<double>(),
              1e-12);
  // A cell's target is the mean of its valid pixels; NaN under the mask stays out.
  auto mask = torch::ones({2, 1, 8, 8}, torch::kBool);
  mask.index_put_({torch::indexing::Slice(), 0, 0, torch::indexing::Slice()}, false);
  const auto dirty = target.masked_fill(mask.logical_not(), NAN);
  EXPECT_TRUE(multi_scale_loss(loss, {fine, coarse}, dirty, {}, mask).isfinite().item<bool>());
  EXPECT_NE(message_of([&] {
              (void)multi_scale_loss(loss, {fine}, target, {1.0, 2.0});
            }).find("one per scale"),
            std::string::npos);
  EXPECT_NE(message_of([&] { (void)multi_scale_loss(loss, {}, target); }).find("no scales"), std::string::npos);
  EXPECT_NE(message_of([&] { (void)multi_scale_loss(loss, {scale(9)}, target); }).find("coarser"), std::string::npos);
}

TEST(Channels, TermsOverTheChannelAxisTakeOneRaw) {
  const UncertaintyLoss loss(config_of({"l2"}, {"inv"}, {"log"}, {"softplus"}));
  const auto p = torch::randn({2, 2, 3, 3}, kDouble), t = torch::randn({2, 2, 3, 3}, kDouble);
  const auto r = torch::randn({2, 1, 3, 3}, kDouble);
  const auto each = loss(p, r, t, std::nullopt, std::nullopt, Reduction::kNone);
  EXPECT_EQ(each.sizes(), r.sizes());
  auto mask = torch::ones({2, 2, 3, 3}, torch::kBool);
  mask.index_put_({0, 1, 0, 0}, false);
  EXPECT_EQ(loss(p, r, t, mask, std::nullopt, Reduction::kNone).index({0, 0, 0, 0}).item<double>(), 0.0);
  EXPECT_NE(message_of([&] { (void)loss(p, p, t); }).find("one channel"), std::string::npos);
}

TEST(Classes, IndicesEqualOneHotProbabilities) {
  const UncertaintyLoss loss(config_of({"cross_entropy"}, {"inv"}, {"log"}, {"softplus"}));
  const auto logits = torch::randn({2, 5, 3, 3}, kDouble), r = torch::randn({2, 1, 3, 3}, kDouble);
  auto index = torch::randint(0, 5, {2, 3, 3}, torch::kLong);
  const auto hot = torch::one_hot(index, 5).permute({0, 3, 1, 2}).to(torch::kFloat64);
  EXPECT_NEAR(loss(logits, r, index).item<double>(), loss(logits, r, hot).item<double>(), 1e-12);
  index.index_put_({0, 0, 0}, 255);
  EXPECT_NE(message_of([&] { (void)loss(logits, r, index); }).find("class 255"), std::string::npos);
  EXPECT_TRUE(loss(logits, r, index, index != 255).isfinite().item<bool>());
}

}  // namespace
}  // namespace ajna::loss
