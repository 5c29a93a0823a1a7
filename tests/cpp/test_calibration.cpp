// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "ajna/nn/calibration.hpp"
#include "ajna/nn/checkpoint.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using namespace ajna::testing;

/// Isotonic regression by its min-max formula: max over i <= k of min over j >= k of the mean of i..j.
std::vector<double> min_max_isotonic(const std::vector<double>& y, const std::vector<double>& w) {
  std::vector<double> result(y.size());
  for (std::size_t k = 0; k < y.size(); ++k) {
    double best = -std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i <= k; ++i) {
      double least = std::numeric_limits<double>::infinity();
      double sum = 0, weight = 0;
      for (std::size_t j = i; j < y.size(); ++j) {
        sum += w[j] * y[j];
        weight += w[j];
        if (j >= k) least = std::min(least, sum / weight);
      }
      best = std::max(best, least);
    }
    result[k] = best;
  }
  return result;
}

torch::Tensor doubles(const std::vector<double>& values) { return torch::tensor(values, torch::kFloat64); }

torch::Tensor all_valid(std::int64_t height, std::int64_t width) { return torch::ones({height, width}, torch::kBool); }

TEST(IsotonicRegression, EqualsTheMinMaxFormula) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform(0.1, 3.0);
  for (int trial = 0; trial < 50; ++trial) {
    const std::size_t count = 1 + random() % 20;
    std::vector<double> y, w;
    for (std::size_t i = 0; i < count; ++i) {
      y.push_back(std::round(4 * (normal(random) + 0.1 * static_cast<double>(i))) / 4);  // with ties
      w.push_back(uniform(random));
    }
    EXPECT_TRUE(torch::allclose(isotonic_regression(doubles(y), doubles(w)), doubles(min_max_isotonic(y, w)), 1e-10));
  }
  const auto rising = doubles({1, 2, 2, 5});
  EXPECT_TRUE(isotonic_regression(rising, torch::ones_like(rising)).equal(rising));
  EXPECT_EQ(isotonic_regression(doubles({}), doubles({})).numel(), 0);
  expect_error(ErrorKind::kInvalidArgument, "one length", [] { isotonic_regression(doubles({1}), doubles({1, 1})); });
  expect_error(ErrorKind::kInvalidArgument, "above 0", [] { isotonic_regression(doubles({1}), doubles({0})); });
  expect_error(ErrorKind::kInvalidArgument, "finite", [] { isotonic_regression(doubles({NAN}), doubles({1})); });
}

TEST(ExpectedErrorFit, FindsTheErrorsThatWereMade) {
  // The table is wrong by a factor and a power; the errors are 0.3 exp(raw / 3) on average.
  torch::manual_seed(1);
  const double flow_scale = 2.0;
  ExpectedErrorFit fit(paper_table(), flow_scale);
  const auto truth = [](const torch::Tensor& raw) { return 0.3 * (raw / 3).exp(); };
  for (int image = 0; image < 40; ++image) {
    const auto raw = torch::randn({2, 60, 80}) * 2;
    const auto error = truth(raw) * -torch::rand_like(raw).log() * torch::randn_like(raw).sign();
    fit.add(raw, error, all_valid(60, 80));
  }
  EXPECT_EQ(fit.images(), 40);
  EXPECT_EQ(fit.pixels(), 40 * 4800);
  const auto table = fit.table();
  table.check();
  EXPECT_TRUE(table.uncertainty.equal(paper_table().uncertainty));
  const auto raw = torch::linspace(-4.5, 4.5, 91);
  const auto got = table.evaluate(raw).expected_error * flow_scale, expected = truth(raw);
  EXPECT_LT(((got - expected) / expected).abs().max().item<double>(), 0.08);
  // Tails: flat below what was seen, the old curve's shape above.
  const auto curve = table.expected_error, old = paper_table().expected_error;
  EXPECT_TRUE(curve.slice(0, 0, 100).equal(curve[0].expand({100})));
  EXPECT_GT(curve[0].item<double>(), 0.0);
  const auto ratio = curve.slice(0, 700) / old.slice(0, 700);
  EXPECT_LT((ratio / ratio[0] - 1).abs().max().item<double>(), 1e-4);
  EXPECT_GE(curve.diff().min().item<float>(), 0.F);
}

TEST(ExpectedErrorFit, WeighsImagesOrPixelsAlike) {
  // 10 pixels with error 1 and 1000 with error 3, all at one raw.
  for (const auto& [weighting, mean] :
       {std::pair{PixelWeighting::kImage, 2.0}, {PixelWeighting::kPixel, 3010 / 1010.0}}) {
    ExpectedErrorFit fit(paper_table(), 1.0, weighting);
    fit.add(torch::ones({2, 1, 10}), torch::full({2, 1, 10}, -1.0), all_valid(1, 10));
    fit.add(torch::ones({2, 1, 1000}), torch::full({2, 1, 1000}, 3.0), all_valid(1, 1000));
    EXPECT_NEAR(fit.table().evaluate(torch::ones({1})).expected_error.item<double>(), mean, 1e-5);
  }
  EXPECT_EQ(parse_pixel_weighting("pixel"), PixelWeighting::kPixel);
  expect_error(ErrorKind::kInvalidArgument, "did you mean 'image'", [] { parse_pixel_weighting("imge"); });
}

TEST(ExpectedErrorFit, IgnoresWhatIsNotValidAndRefusesTheRest) {
  ExpectedErrorFit fit(paper_table(), 1.0);
  expect_error(ErrorKind::kInvalidArgument, "without images", [&] { (void)fit.table(); });
  auto valid = torch::zeros({2, 2}, torch::kBool);
  const auto nan = torch::full({2, 2, 2}, NAN);
  fit.add(nan, nan, valid);
  EXPECT_EQ(fit.images(), 0);
  valid[0][1] = true;
  auto raw = nan.clone(), error = nan.clone();
  raw.index_put_({torch::indexing::Slice(), 0, 1}, 0.5);
  expect_error(ErrorKind::kInvalidArgument, "error holds NaN", [&] { fit.add(raw, error, valid); });
  error.index_put_({torch::indexing::Slice(), 0, 1}, 0.25);
  fit.add(raw, error, valid);
  EXPECT_EQ(fit.pixels(), 1);
  EXPECT_NEAR(fit.table().evaluate(torch::tensor({0.5F})).expected_error.item<double>(), 0.25, 1e-6);
  expect_error(ErrorKind::kInvalidArgument, "[2, H, W]", [&] { fit.add(raw[0], error[0], valid); });
  expect_error(ErrorKind::kInvalidArgument, "bool [H, W]", [&] { fit.add(raw, error, valid.to(torch::kFloat32)); });
  expect_error(ErrorKind::kInvalidArgument, "flow_scale", [] { ExpectedErrorFit(paper_table(), 0.0); });
  expect_error(ErrorKind::kInvalidArgument, "min_share",
               [] { ExpectedErrorFit(paper_table(), 1.0, PixelWeighting::kImage, 2.0); });
}

TEST(ConformalFit, OfOnePixelPerImageIsTheOrderStatistic) {
  std::mt19937 random(5);
  std::exponential_distribution<float> exponential;
  for (const auto weighting : {PixelWeighting::kImage, PixelWeighting::kPixel}) {
    ConformalFit fit(weighting);
    std::vector<double> scores;
    for (int i = 0; i < 57; ++i) {
      const float score = exponential(random);
      scores.push_back(score);
      fit.add(torch::full({2, 1, 1}, 2.F), torch::tensor({2 * score, -2 * score}).view({2, 1, 1}), all_valid(1, 1));
    }
    std::sort(scores.begin(), scores.end());
    for (const double p : {0.1, 0.5, 0.9, 0.95}) {
      const double exact = scores[static_cast<std::size_t>(std::ceil(58 * p)) - 1];
      const auto pair = fit.factors({p}).factors[0];
      for (const double factor : pair) {
        EXPECT_GE(factor, exact * (1 - 1e-6)) << p;  // never below
        EXPECT_LE(factor, exact * 1.0051) << p;
      }
    }
    EXPECT_TRUE(fit.reaches(57.0 / 58));
    EXPECT_FALSE(fit.reaches(0.985));
  }
}

TEST(ConformalFit, CoversNewImagesAtLeastAsPromised) {
  // Images of very different size and difficulty, so that the pixels are far from independent.
  std::mt19937 random(7);
  torch::manual_seed(7);
  const auto image = [&](std::int64_t& width) {
    width = 1 + static_cast<std::int64_t>(random() % 400);
    const double difficulty = std::exponential_distribution<double>()(random);
    return torch::randn({2, 1, width}) * difficulty;
  };
  std::int64_t width = 0;
  double covered = 0;
  constexpr int kTrials = 150, kImages = 19;
  for (int trial = 0; trial < kTrials; ++trial) {
    ConformalFit fit;
    for (int i = 0; i < kImages; ++i) {
      const auto error = image(width);
      fit.add(torch::ones_like(error), error, all_valid(1, width));
    }
    const auto factor = fit.factors({0.9}).factors[0];
    covered += (image(width)[0].abs() <= factor[0]).to(torch::kFloat64).mean().item<double>();
  }
  EXPECT_GT(covered / kTrials, 0.9 - 0.03);  // standard error about 0.012
  EXPECT_LT(covered / kTrials, 1.0 - 0.005);
}

TEST(ConformalFit, SaysWhatALevelNeeds) {
  ConformalFit fit;
  const auto one = torch::ones({2, 2, 3});
  for (int i = 0; i < 9; ++i) {
    fit.add(one, one * (i + 1), all_valid(2, 3));
  }
  EXPECT_NEAR(fit.factors({0.5, 0.9}).factors[1][0], 9.0, 0.05);
  const auto refused = [&](const std::string& part, const std::vector<double>& levels) {
    expect_error(ErrorKind::kInvalidArgument, part, [&] { (void)fit.factors(levels); });
  };
  refused("needs at least 19 images, there are 9", {0.5, 0.95});
  refused("not inside (0, 1)", {1.0});
  refused("strictly rising", {0.9, 0.5});
  refused("at least one level", {});
  ConformalFit zero;
  for (int i = 0; i < 9; ++i) {
    zero.add(torch::zeros({2, 2, 3}), i < 5 ? torch::zeros({2, 2, 3}) : one, all_valid(2, 3));
  }
  EXPECT_LE(zero.factors({0.5}).factors[0][0], 1e-4);
  expect_error(ErrorKind::kInvalidArgument, "no error is expected", [&] { (void)zero.factors({0.9}); });
}

class CalibratedCheckpoint : public ::testing::Test {
 protected:
  CalibratedCheckpoint() : net_(small_net()), metadata_(small_metadata(*net_)) {
    metadata_.calibration =
        Calibration{{{0.5, 1.0 / 3 + 0.5}, {{0.7, 0.8}, {2.25, 1e-3 + 2}}},
                    {{"data", "scenes"}, {"images", "9"}, {"pixels", "77"}, {"date", "2026-01-02"}}};
  }
  FlowNet net_;
  Metadata metadata_;
};

TEST_F(CalibratedCheckpoint, RoundTripKeepsEveryBit) {
  const TemporaryFolder folder;
  save_checkpoint(folder.file("a.safetensors"), *net_, metadata_);
  const auto loaded = load_checkpoint(folder.file("a.safetensors")).metadata;
  ASSERT_TRUE(loaded.calibration.has_value());
  EXPECT_TRUE(loaded.calibration->factors == metadata_.calibration->factors);
  EXPECT_EQ(loaded.calibration->provenance, metadata_.calibration->provenance);
  EXPECT_EQ(loaded.provenance, metadata_.provenance);
  metadata_.calibration.reset();
  save_checkpoint(folder.file("b.safetensors"), *net_, metadata_);
  EXPECT_FALSE(load_checkpoint(folder.file("b.safetensors")).metadata.calibration.has_value());
}

TEST_F(CalibratedCheckpoint, IsReadStrictly) {
  const auto refused = [&](const std::string& part, const auto& change) {
    auto strings = metadata_to_strings(metadata_);
    change(strings);
    expect_error(ErrorKind::kInvalidArgument, part, [&] { metadata_from_strings(strings); });
  };
  refused("version '2'", [](auto& s) { s["calibration.version"] = "2"; });
  refused("no 'calibration.version'", [](auto& s) { s.erase("calibration.version"); });
  refused("no 'calibration.levels'", [](auto& s) { s.erase("calibration.levels"); });
  refused("no 'calibration.factors_v'", [](auto& s) { s.erase("calibration.factors_v"); });
  refused("1 numbers for 2 levels", [](auto& s) { s["calibration.factors_u"] = "1"; });
  refused("not a number", [](auto& s) { s["calibration.factors_u"] = "1  2"; });
  refused("not a number", [](auto& s) { s["calibration.levels"] = ""; });
  refused("strictly rising", [](auto& s) { s["calibration.levels"] = "0.9 0.5"; });
  refused("do not fall", [](auto& s) { s["calibration.factors_u"] = "2 1"; });
  refused("finite", [](auto& s) { s["calibration.factors_u"] = "1 inf"; });
  refused("'data'", [](auto& s) { s.erase("calibration.provenance.data"); });
  refused("'date'", [](auto& s) { s["calibration.provenance.date"] = ""; });
  refused("'calibration.colour' is unknown", [](auto& s) { s["calibration.colour"] = "red"; });
  metadata_.calibration->factors.levels = {0.5};
  expect_error(ErrorKind::kInvalidArgument, "pairs of factors", [&] { metadata_to_strings(metadata_); });
}

}  // namespace
}  // namespace ajna::nn
