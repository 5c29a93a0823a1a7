// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <torch/torch.h>

#include <cmath>
#include <limits>
#include <set>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/synth/augment.hpp"
#include "ajna/synth/color.hpp"
#include "synth_checks.hpp"

namespace ajna::synth {
namespace {

using torch::Tensor;

/// Nothing but a crop; tests switch on what they look at.
AugmentConfig none() { return augment_preset("none").config; }

/// All that moves pixels, and nothing that changes their colours.
AugmentConfig geometric() {
  AugmentConfig config;
  config.color_probability = config.blur_probability = config.patch_probability = config.asymmetric_probability = 0;
  config.spatial_probability = config.relative_probability = 1;
  return config;
}

/// Smooth pictures of B affine motions, known in closed form both ways: frame1(x) = T(x), frame2(G x) = T(x).
struct AffinePairs {
  Tensor forward, backward;  // G and its inverse, [B, 3, 3] float32
  LabelledPairs pairs;
};

Tensor picture(const Tensor& x, const Tensor& y) {
  std::vector<Tensor> channels;
  for (int c = 0; c < 3; ++c) {
    channels.push_back(0.5 + 0.22 * torch::sin(0.13 * x + 0.05 * y * (c + 1)) +
                       0.22 * torch::cos(0.11 * y - 0.04 * x * c));
  }
  return (torch::stack(channels, 1) * 255).round().clamp(0, 255).to(torch::kUInt8);
}

AffinePairs affine_pairs(std::int64_t batch, std::int64_t height, std::int64_t width, double shift) {
  torch::manual_seed(3);
  AffinePairs result;
  result.forward = torch::eye(3).repeat({batch, 1, 1});
  result.forward.slice(1, 0, 2).slice(2, 0, 2).add_(torch::randn({batch, 2, 2}) * 0.02);
  result.forward.slice(1, 0, 2).select(2, 2).copy_(torch::randn({batch, 2}) * shift);
  result.backward = torch::linalg_inv(result.forward);
  const auto u = torch::arange(width, torch::kFloat32).view({1, 1, -1});
  const auto v = torch::arange(height, torch::kFloat32).view({1, -1, 1});
  const auto map = [&](const Tensor& g) {
    const auto a = [&](int r, int c) { return g.select(1, r).select(1, c).view({-1, 1, 1}); };
    return std::pair(a(0, 0) * u + a(0, 1) * v + a(0, 2), a(1, 0) * u + a(1, 1) * v + a(1, 2));
  };
  const auto [to_u, to_v] = map(result.forward);
  const auto [from_u, from_v] = map(result.backward);
  auto& p = result.pairs;
  p.frame1 = picture(u.expand({batch, height, width}), v.expand({batch, height, width}));
  p.frame2 = picture(from_u, from_v);
  p.flow = torch::stack({to_u - u, to_v - v}, 1);
  p.flow_backward = torch::stack({from_u - u, from_v - v}, 1);
  const auto outside = [&](const Tensor& x, const Tensor& y) {
    return (((x + 0.5) * (width - 0.5 - x) < 0).logical_or((y + 0.5) * (height - 0.5 - y) < 0)).unsqueeze(1);
  };
  p.occlusion = outside(to_u, to_v);
  p.occlusion_backward = outside(from_u, from_v);
  return result;
}

/// Mean absolute difference in grey levels between frame 1 and frame 2 looked up along the flow, where it is visible.
double identity_error(const Tensor& frame1, const Tensor& frame2, const Tensor& flow, const Tensor& use) {
  const auto error = (testing::warp(frame2, flow) - frame1.to(torch::kFloat32)).abs().mean(1, true);
  return error.masked_select(use).mean().item<double>();
}

TEST(Augmenter, GeometricChangesKeepTheWarpIdentityBothWays) {
  auto config = geometric();
  config.swap_probability = 0.5;
  const auto given = affine_pairs(24, 80, 110, 3.0);
  const auto made = Augmenter(config).augment(given.pairs, 56, 72, 4);
  const auto use = made.valid.logical_and(made.occlusion.logical_not());
  ASSERT_GT(use.to(torch::kFloat32).mean().item<float>(), 0.6F);
  EXPECT_LT(identity_error(made.frame1, made.frame2, made.flow, use), 1.0);
  const auto back = made.valid_backward.logical_and(made.occlusion_backward.logical_not());
  EXPECT_LT(identity_error(made.frame2, made.frame1, made.flow_backward, back), 1.0);
  // The flow without its change would not do.
  EXPECT_GT(identity_error(made.frame1, made.frame2, torch::zeros_like(made.flow), use), 5.0);
  // And the backward flow undoes the forward flow.
  const auto round_trip = made.flow + testing::warp(made.flow_backward, made.flow);
  EXPECT_LT(round_trip.abs().amax(1, true).masked_select(testing::eroded(use, 2)).median().item<float>(), 5e-3F);
}

TEST(Augmenter, AffineMotionStaysAffine) {
  const auto given = affine_pairs(12, 80, 110, 3.0);
  const auto made = Augmenter(geometric()).augment(given.pairs, 50, 60, 9);
  const auto u = torch::arange(60, torch::kFloat64).view({1, -1}).expand({50, 60}).reshape({-1});
  const auto v = torch::arange(50, torch::kFloat64).view({-1, 1}).expand({50, 60}).reshape({-1});
  for (std::int64_t b = 0; b < 12; ++b) {
    const auto valid = made.valid[b].view({-1}).nonzero().squeeze(1);
    const auto rows = torch::stack({u, v, torch::ones_like(u)}, 1).index_select(0, valid);
    const auto flow = made.flow[b].view({2, -1}).t().to(torch::kFloat64).index_select(0, valid);
    const auto fit = std::get<0>(torch::linalg_lstsq(rows, flow, std::nullopt, "gelsd"));
    // At the frame's rim there is nothing to interpolate with: half a pixel off in a flow that changes by 0.02 a pixel.
    EXPECT_LT((rows.matmul(fit) - flow).abs().max().item<double>(), 0.05) << "pair " << b;
    EXPECT_LT((rows.matmul(fit) - flow).abs().median().item<double>(), 1e-3) << "pair " << b;
  }
}

TEST(Augmenter, ScenesKeepTheWarpIdentity) {
  const PairGenerator generator(testing::cleaned({}), 3);
  const auto scene = generator.generate(12, 96, 128, 11);
  LabelledPairs pairs;
  pairs.frame1 = scene.frame1;
  pairs.frame2 = scene.frame2;
  pairs.flow = scene.flow;
  pairs.occlusion = scene.occlusion;
  pairs.motion_boundary = scene.motion_boundary;
  const auto made = Augmenter(geometric()).augment(pairs, 64, 96, 2);
  const auto smooth = made.occlusion.logical_or(made.motion_boundary).logical_not();
  const auto use = testing::eroded(made.valid.logical_and(smooth), 2);
  ASSERT_GT(use.to(torch::kFloat32).mean().item<float>(), 0.25F);
  const auto error = (testing::warp(made.frame2, made.flow) - made.frame1.to(torch::kFloat32)).abs().mean(1, true);
  EXPECT_LT(error.masked_select(use).median().item<float>(), 2.0F);
  EXPECT_LT(error.masked_select(use).mean().item<float>(), 4.0F);
}

TEST(Augmenter, ZeroStrengthIsTheIdentity) {
  auto config = AugmentConfig{};  // everything is applied, with no strength
  config.brightness = config.contrast = config.hue = config.saturation = config.gamma = config.noise = 0;
  config.blur_max_px = 0;
  config.scale_min = config.scale_max = config.stretch = config.rotation_deg = 0;
  config.flip_x_probability = config.flip_y_probability = 0;
  config.relative_translation = config.relative_rotation_deg = config.relative_scale = 0;
  config.patch_probability = 0;
  auto given = affine_pairs(4, 40, 56, 2.0).pairs;
  given.motion_boundary = given.occlusion.clone();
  given.motion_boundary_backward = given.occlusion_backward.clone();
  for (const auto& options : {config, none()}) {
    const auto made = Augmenter(options).augment(given, 40, 56, 8);
    EXPECT_LE((made.frame1.to(torch::kInt) - given.frame1.to(torch::kInt)).abs().max().item<int>(), 1);
    EXPECT_LE((made.frame2.to(torch::kInt) - given.frame2.to(torch::kInt)).abs().max().item<int>(), 1);
    EXPECT_TRUE(torch::allclose(made.flow, given.flow, 1e-4, 1e-3));
    EXPECT_TRUE(torch::allclose(made.flow_backward, given.flow_backward, 1e-4, 1e-3));
    EXPECT_TRUE(made.valid.all().item<bool>());
    EXPECT_TRUE(torch::equal(made.motion_boundary, given.motion_boundary));
    EXPECT_LE((made.occlusion != given.occlusion).sum().item<int>(), 2);
  }
}

TEST(Augmenter, CropsAreWindowsOfTheFrames) {
  const auto given = affine_pairs(6, 40, 56, 2.0).pairs;
  const auto made = Augmenter(none()).augment(given, 24, 32, 8);
  std::set<std::pair<int, int>> places;
  for (std::int64_t b = 0; b < 6; ++b) {
    bool found = false;
    for (int top = 0; top <= 16; ++top) {
      for (int left = 0; left <= 24; ++left) {
        const auto window = [&](const Tensor& x) { return x[b].slice(1, top, top + 24).slice(2, left, left + 32); };
        if (torch::equal(made.frame1[b], window(given.frame1)) && torch::equal(made.frame2[b], window(given.frame2)) &&
            torch::allclose(made.flow[b], window(given.flow), 1e-4, 1e-3)) {
          found = true;
          places.insert({top, left});
        }
      }
    }
    EXPECT_TRUE(found) << "pair " << b;
  }
  EXPECT_GT(places.size(), 3U);
}

TEST(Augmenter, FlipsMirrorFramesAndNegateTheFlow) {
  const auto given = affine_pairs(2, 40, 56, 2.0).pairs;
  auto config = none();
  config.flip_x_probability = 1;
  const auto across = Augmenter(config).augment(given, 40, 56, 1);
  EXPECT_TRUE(torch::equal(across.frame1, given.frame1.flip(3)));
  EXPECT_TRUE(torch::allclose(across.flow.select(1, 0), -given.flow.flip(3).select(1, 0), 1e-4, 1e-3));
  EXPECT_TRUE(torch::allclose(across.flow.select(1, 1), given.flow.flip(3).select(1, 1), 1e-4, 1e-3));
  config.flip_x_probability = 0;
  config.flip_y_probability = 1;
  const auto down = Augmenter(config).augment(given, 40, 56, 1);
  EXPECT_TRUE(torch::equal(down.frame2, given.frame2.flip(2)));
  EXPECT_TRUE(torch::allclose(down.flow.select(1, 0), given.flow.flip(2).select(1, 0), 1e-4, 1e-3));
  EXPECT_TRUE(torch::allclose(down.flow.select(1, 1), -given.flow.flip(2).select(1, 1), 1e-4, 1e-3));
}

TEST(Augmenter, RotationTurnsAndScaleStretchesTheFlow) {
  LabelledPairs given = affine_pairs(16, 40, 56, 2.0).pairs;
  given.flow = torch::tensor({3.0F, 4.0F}).view({1, 2, 1, 1}).expand({16, 2, 40, 56}).contiguous();
  auto config = none();
  config.spatial_probability = 1;
  config.stretch_probability = 0;
  config.scale_min = config.scale_max = 0;
  config.rotation_deg = 60;
  const auto turned = Augmenter(config).augment(given, 30, 30, 1);
  const auto length = turned.flow.norm(2, 1, true).masked_select(turned.valid);
  EXPECT_LT((length - 5).abs().max().item<float>(), 1e-3F);
  const auto middle = turned.flow.slice(2, 15, 16).slice(3, 15, 16).flatten(1);
  const auto angle = torch::atan2(middle.select(1, 1), middle.select(1, 0)) - std::atan2(4.0, 3.0);
  EXPECT_LE(angle.abs().max().item<float>(), 60.1 / 180 * 3.14159265);
  EXPECT_GT(angle.std().item<float>(), 0.3F);
  config.rotation_deg = 0;
  config.scale_min = config.scale_max = 1;  // twice as large
  const auto larger = Augmenter(config).augment(given, 30, 30, 1);
  EXPECT_LT((larger.flow - 2 * given.flow.slice(2, 0, 30).slice(3, 0, 30)).abs().max().item<float>(), 1e-3F);
}

TEST(Augmenter, SwappingTwiceGivesThePairBack) {
  auto config = none();
  config.swap_probability = 1;
  const auto given = affine_pairs(3, 40, 56, 2.0).pairs;
  const Augmenter augmenter(config);
  const auto once = augmenter.augment(given, 40, 56, 1);
  EXPECT_TRUE(torch::equal(once.frame1, given.frame2));
  EXPECT_TRUE(torch::allclose(once.flow, given.flow_backward, 1e-4, 1e-3));
  const auto use = once.valid.logical_and(once.occlusion.logical_not());
  EXPECT_LT(identity_error(once.frame1, once.frame2, once.flow, use), 1.0);
  const auto twice = augmenter.augment(once, 40, 56, 2);
  EXPECT_TRUE(torch::equal(twice.frame1, given.frame1));
  EXPECT_TRUE(torch::equal(twice.frame2, given.frame2));
  EXPECT_TRUE(torch::allclose(twice.flow, given.flow, 1e-4, 2e-3));
}

TEST(Augmenter, TheValidRegionMovesWithThePixels) {
  auto given = affine_pairs(16, 60, 80, 1.0).pairs;
  given.valid = torch::zeros({16, 1, 60, 80}, torch::kBool);
  given.valid.slice(2, 12, 48).slice(3, 10, 70).fill_(true);
  given.frame1 = given.valid.expand({16, 3, 60, 80}).to(torch::kUInt8) * 255;  // paint it
  const auto made = Augmenter(geometric()).augment(given, 60, 80, 6);
  const auto painted = made.frame1.slice(1, 0, 1) > 127;
  const auto wrong = (painted != made.valid).to(torch::kFloat32).mean().item<float>();
  EXPECT_LT(wrong, 0.01F);  // the rim, by rounding
  EXPECT_GT(made.valid.to(torch::kFloat32).mean().item<float>(), 0.3F);
  EXPECT_TRUE((made.flow * made.valid.logical_not()).abs().max().item<float>() == 0.0F);
}

TEST(Augmenter, CornersOutsideTheFrameAreNotValid) {
  auto config = none();
  config.spatial_probability = 1;
  config.stretch_probability = 0;
  config.scale_min = config.scale_max = 0;
  config.rotation_deg = 45;
  const auto given = affine_pairs(32, 48, 48, 1.0).pairs;
  const auto made = Augmenter(config).augment(given, 48, 48, 6);
  // A square turned by an angle t about its centre keeps 1 - (1 - |cos t| + ...) of itself: at 45 degrees 2 (sqrt 2 -
  // 1).
  const auto kept = made.valid.to(torch::kFloat32).mean({1, 2, 3});
  EXPECT_GT(kept.min().item<float>(), 2 * (std::sqrt(2.0F) - 1) - 0.02F);
  EXPECT_LT(kept.min().item<float>(), 0.9F);
  EXPECT_GT(kept.max().item<float>(), 0.93F);
}

TEST(Augmenter, NanFlowOfInvalidPixelsNeverLeaks) {
  auto config = geometric();
  config.swap_probability = 0.5;
  auto given = affine_pairs(8, 60, 80, 1.0).pairs;
  torch::manual_seed(1);
  const auto holes = torch::rand({8, 1, 60, 80}) < 0.1;
  auto zeroed = given;
  zeroed.valid = holes.logical_not();
  zeroed.valid_backward = holes.logical_not();
  zeroed.flow = given.flow * zeroed.valid;
  zeroed.flow_backward = given.flow_backward * zeroed.valid;
  auto poisoned = zeroed;
  const auto nan = torch::full({1}, std::numeric_limits<float>::quiet_NaN());
  poisoned.flow = torch::where(holes, nan, given.flow);
  poisoned.flow_backward = torch::where(holes, nan, given.flow_backward);
  const Augmenter augmenter(config);
  const auto a = augmenter.augment(zeroed, 40, 60, 3), b = augmenter.augment(poisoned, 40, 60, 3);
  poisoned.valid = poisoned.valid_backward = Tensor();  // NaN alone says so, too
  const auto c = augmenter.augment(poisoned, 40, 60, 3);
  for (const auto& made : {b, c}) {
    EXPECT_TRUE(made.flow.isfinite().all().item<bool>());
    EXPECT_TRUE(made.flow_backward.isfinite().all().item<bool>());
    EXPECT_TRUE(torch::equal(made.flow, a.flow));
    EXPECT_TRUE(torch::equal(made.valid, a.valid));
  }
  EXPECT_GT(a.valid.logical_not().to(torch::kFloat32).mean().item<float>(), 0.05F);
}

TEST(Augmenter, PatchesHideWhatTheyCover) {
  auto config = none();
  config.patch_probability = 1;
  auto given = affine_pairs(8, 60, 80, 2.0).pairs;
  const auto made = Augmenter(config).augment(given, 60, 80, 6);
  const auto covered = (made.frame2 != given.frame2).any(1, true);
  ASSERT_GT(covered.to(torch::kFloat32).mean().item<float>(), 0.01F);
  const auto hit = testing::warp(covered.to(torch::kFloat32), made.flow) > 0.99;
  EXPECT_TRUE(made.occlusion.masked_select(hit).all().item<bool>());
  EXPECT_GT(made.occlusion.sum().item<int>(), given.occlusion.sum().item<int>());
  EXPECT_TRUE(torch::equal(made.frame1, given.frame1));
  EXPECT_TRUE(torch::allclose(made.flow, given.flow, 1e-4, 1e-3));
}

TEST(Augmenter, SymmetricColourChangesAreAlikeAndAsymmetricOnesAreNot) {
  auto given = affine_pairs(12, 40, 56, 0.0).pairs;
  given.frame2 = given.frame1.clone();
  auto config = none();
  config.color_probability = 1;
  config.noise = 0;
  const auto alike = Augmenter(config).augment(given, 40, 56, 6);
  EXPECT_TRUE(torch::equal(alike.frame1, alike.frame2));
  EXPECT_FALSE(torch::equal(alike.frame1, given.frame1));
  config.asymmetric_probability = 1;
  const auto apart = Augmenter(config).augment(given, 40, 56, 6);
  const auto difference = (apart.frame1.to(torch::kFloat32) - apart.frame2.to(torch::kFloat32)).abs().mean({1, 2, 3});
  EXPECT_GT(difference.min().item<float>(), 1.0F);
  config = none();
  config.color_probability = 1;
  config.brightness = config.contrast = config.hue = config.saturation = config.gamma = 0;
  config.noise = 0.1;
  const auto noisy = Augmenter(config).augment(given, 40, 56, 6);
  const auto noise = (noisy.frame1.to(torch::kFloat32) - given.frame1.to(torch::kFloat32)) / 255.0;
  EXPECT_LT(noise.std({1, 2, 3}).max().item<float>(), 0.105F);
  EXPECT_GT(noise.std({1, 2, 3}).mean().item<float>(), 0.02F);
  EXPECT_LT(noise.mean().abs().item<float>(), 0.005F);
}

TEST(Color, HueTurnsAndSaturationScaleInHsv) {
  const auto red = torch::tensor({1.0F, 0.0F, 0.0F}).view({1, 3, 1, 1});
  const auto one = torch::ones({1}), third = torch::full({1}, 1.0 / 3.0);
  EXPECT_TRUE(
      torch::allclose(turn_hue(red, third, one), torch::tensor({0.0F, 1.0F, 0.0F}).view({1, 3, 1, 1}), 0, 1e-5));
  EXPECT_TRUE(
      torch::allclose(turn_hue(red, -third, one), torch::tensor({0.0F, 0.0F, 1.0F}).view({1, 3, 1, 1}), 0, 1e-5));
  torch::manual_seed(2);
  const auto image = torch::rand({4, 3, 9, 9});
  EXPECT_TRUE(torch::allclose(turn_hue(image, torch::zeros({4}), torch::ones({4})), image, 0, 1e-5));
  EXPECT_TRUE(torch::allclose(turn_hue(image, torch::ones({4}), torch::ones({4})), image, 0, 1e-4));
  const auto grey = turn_hue(image, torch::zeros({4}), torch::zeros({4}));
  EXPECT_TRUE(torch::allclose(grey, image.amax(1, true).expand_as(image), 0, 1e-5));
}

TEST(Color, BrightnessContrastAndGammaFollowTheirFormulas) {
  torch::manual_seed(2);
  const auto image = 0.3 + 0.2 * torch::rand({2, 3, 9, 9});
  const auto mean = image.mean({2, 3});
  const auto zero = torch::zeros({2}), one = torch::ones({2});
  EXPECT_TRUE(torch::allclose(change_color(image, mean, {zero + 0.1, one, zero, one, one}), image + 0.1, 0, 1e-4));
  const auto contrast = change_color(image, mean, {zero, one * 1.4, zero, one, one});
  EXPECT_TRUE(torch::allclose(contrast, (image - mean.view({2, 3, 1, 1})) * 1.4 + mean.view({2, 3, 1, 1}), 0, 1e-4));
  EXPECT_TRUE(torch::allclose(change_color(image, mean, {zero, one, zero, one, one * 0.9}), image.pow(0.9), 0, 1e-4));
}

TEST(Augmenter, EqualSeedsGiveEqualBitsAndShapesAreAsDocumented) {
  const auto given = affine_pairs(3, 60, 80, 2.0).pairs;
  const Augmenter augmenter{AugmentConfig{}};
  const auto a = augmenter.augment(given, 40, 48, 5), b = augmenter.augment(given, 40, 48, 5);
  const auto c = augmenter.augment(given, 40, 48, 6);
  EXPECT_EQ(a.frame1.sizes(), (std::vector<std::int64_t>{3, 3, 40, 48}));
  EXPECT_EQ(a.frame1.scalar_type(), torch::kUInt8);
  EXPECT_EQ(a.flow.sizes(), (std::vector<std::int64_t>{3, 2, 40, 48}));
  EXPECT_EQ(a.valid.scalar_type(), torch::kBool);
  EXPECT_FALSE(a.motion_boundary.defined());
  for (const auto member : {&LabelledPairs::frame1, &LabelledPairs::frame2, &LabelledPairs::flow, &LabelledPairs::valid,
                            &LabelledPairs::occlusion, &LabelledPairs::flow_backward}) {
    EXPECT_TRUE(torch::equal(a.*member, b.*member));
  }
  EXPECT_FALSE(torch::equal(a.frame1, c.frame1));
  // A crop larger than the frame enlarges it.
  EXPECT_EQ(augmenter.augment(given, 90, 100, 5).frame2.size(2), 90);
}

TEST(Augmenter, RefusesWhatItCannotDo) {
  const auto message = [](const auto& call) -> std::string {
    try {
      call();
    } catch (const Error& error) {
      return error.what();
    }
    return "did not throw";
  };
  const auto given = affine_pairs(2, 20, 24, 1.0).pairs;
  const Augmenter augmenter{AugmentConfig{}};
  auto config = AugmentConfig{};
  config.hue = 0.7;
  EXPECT_NE(message([&] { Augmenter{config}; }).find("hue = 0.7"), std::string::npos);
  config = none();
  config.swap_probability = 0.5;
  auto one_way = given;
  one_way.flow_backward = one_way.occlusion_backward = Tensor();
  EXPECT_NE(message([&] { (void)Augmenter(config).augment(one_way, 8, 8, 1); }).find("swap_"), std::string::npos);
  EXPECT_EQ(Augmenter(none()).augment(one_way, 8, 8, 1).frame1.size(3), 8);
  auto wrong = given;
  wrong.flow = given.flow.slice(2, 1);
  EXPECT_NE(message([&] { (void)augmenter.augment(wrong, 8, 8, 1); }).find("flow is"), std::string::npos);
  wrong = given;
  wrong.frame2 = given.frame2.to(torch::kFloat32);
  EXPECT_NE(message([&] { (void)augmenter.augment(wrong, 8, 8, 1); }).find("frame2"), std::string::npos);
  EXPECT_NE(message([&] { (void)augmenter.augment(given, 0, 8, 1); }).find("8x0"), std::string::npos);
  EXPECT_NE(message([] { (void)augment_preset("author"); }).find("did you mean 'authors'"), std::string::npos);
}

}  // namespace
}  // namespace ajna::synth
