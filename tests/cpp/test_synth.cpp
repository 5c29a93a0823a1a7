// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <torch/torch.h>

#include <cmath>

#include "ajna/base/error.hpp"
#include "ajna/synth/motion.hpp"
#include "ajna/synth/pair_generator.hpp"
#include "ajna/synth/photometric.hpp"
#include "ajna/synth/shapes.hpp"
#include "synth_checks.hpp"

namespace ajna::synth {
namespace {

using testing::eroded;
using testing::warp;
using torch::Tensor;

/// Scenes without blur, noise or exposure change: what is left is geometry.
SceneConfig clean_config() { return testing::cleaned({}); }

TEST(PairGenerator, WarpingFrame2ReproducesFrame1OnVisiblePixels) {
  const PairGenerator generator(clean_config(), 3);
  const auto pair = generator.generate(12, 96, 128, 11);
  const auto error = (warp(pair.frame2, pair.flow) - pair.frame1.to(torch::kFloat32)).abs().mean(1, true);
  const auto unmoved = (pair.frame2.to(torch::kFloat32) - pair.frame1.to(torch::kFloat32)).abs().mean(1, true);
  // Away from outlines, whose one-pixel transition mixes two layers.
  const auto interior = eroded(pair.occlusion.logical_not().logical_and(pair.motion_boundary.logical_not()), 2);
  ASSERT_GT(interior.to(torch::kFloat32).mean().item<float>(), 0.3F);
  const auto inside = error.masked_select(interior);
  EXPECT_LT(inside.median().item<float>(), 1.0F);
  EXPECT_LT(inside.mean().item<float>(), 2.5F);
  EXPECT_GT(unmoved.masked_select(interior).mean().item<float>(), 2 * inside.mean().item<float>());
}

TEST(PairGenerator, WarpIdentityHoldsToTheNoiseThatWasAdded) {
  auto config = clean_config();
  config.noise_max = 8.0;
  const PairGenerator generator(config, 3);
  const auto pair = generator.generate(8, 96, 128, 5);
  const auto error = warp(pair.frame2, pair.flow) - pair.frame1.to(torch::kFloat32);
  const auto interior = eroded(pair.occlusion.logical_not().logical_and(pair.motion_boundary.logical_not()), 2);
  // Two draws of at most 8 grey levels deviation, the second averaged by the look-up.
  EXPECT_LT(error.abs().mean(1, true).masked_select(interior).median().item<float>(), 8.0F * std::sqrt(2.0F));
}

TEST(PairGenerator, PureTranslationHasThatExactFlow) {
  auto config = clean_config();
  config.layers = 0;
  config.rotation_zoom = 0;
  config.perspective_probability = 0;
  config.nonrigid_probability = 0;
  config.static_probability = 0;
  const PairGenerator generator(config, 1);
  const auto pair = generator.generate(6, 40, 56, 2);
  const auto flow = pair.flow.flatten(2);
  EXPECT_LT((flow - flow.select(2, 0).unsqueeze(2)).abs().max().item<float>(), 1e-4F);
  EXPECT_GT(flow.abs().max().item<float>(), 0.5F);
  EXPECT_FALSE(pair.motion_boundary.any().item<bool>());
  // Exactly the pixels whose target leaves the image are occluded.
  const auto x = torch::arange(56, torch::kFloat32).view({1, 1, -1}) + pair.flow.select(1, 0);
  const auto y = torch::arange(40, torch::kFloat32).view({1, -1, 1}) + pair.flow.select(1, 1);
  const auto outside = (x < -0.5).logical_or(x > 55.5).logical_or(y < -0.5).logical_or(y > 39.5);
  EXPECT_TRUE(torch::equal(pair.occlusion.squeeze(1), outside));
}

TEST(PairGenerator, ZeroMotionIsZeroFlowWithoutOcclusion) {
  const PairGenerator generator(clean_config(), 1);
  const auto pair = generator.generate(4, 48, 64, 9, 0.0);
  EXPECT_LT(pair.flow.abs().max().item<float>(), 1e-4F);
  EXPECT_FALSE(pair.occlusion.any().item<bool>());
  EXPECT_FALSE(pair.motion_boundary.any().item<bool>());
  EXPECT_LE((pair.frame1.to(torch::kInt) - pair.frame2.to(torch::kInt)).abs().max().item<int>(), 1);
}

TEST(PairGenerator, OcclusionAgreesWithBruteForceVisibility) {
  const PairGenerator generator(clean_config(), 7);
  const auto [compared, hidden, wrong] = testing::check_occlusion(generator.generate(16, 96, 128, 21));
  EXPECT_GT(compared, 50000);
  EXPECT_GT(hidden, 200);
  // A bar thinner than a pixel may pass between the grid points of layer2.
  EXPECT_LE(wrong * 100, hidden) << wrong << " of " << compared << " compared pixels, " << hidden << " hidden";
}

TEST(PairGenerator, EqualSeedsGiveEqualBitsAndOtherSeedsOtherScenes) {
  SceneConfig config;
  config.bank_size = 8;
  config.texture_size = 64;
  const PairGenerator first(config, 4), second(config, 4), other_bank(config, 5);
  const auto a = first.generate(3, 48, 64, 17), b = second.generate(3, 48, 64, 17);
  for (const auto member : {&PairBatch::frame1, &PairBatch::frame2, &PairBatch::flow, &PairBatch::occlusion,
                            &PairBatch::motion_boundary, &PairBatch::layer1, &PairBatch::layer2}) {
    EXPECT_TRUE(torch::equal(a.*member, b.*member));
  }
  EXPECT_FALSE(torch::equal(a.flow, first.generate(3, 48, 64, 18).flow));
  EXPECT_FALSE(torch::equal(a.frame1, other_bank.generate(3, 48, 64, 17).frame1));
}

TEST(PairGenerator, ShapesAndTypesAreAsDocumented) {
  auto config = clean_config();
  config.layers = 2;
  const PairGenerator generator(config, 1);
  const auto pair = generator.generate(5, 33, 47, 1);
  EXPECT_EQ(pair.frame1.sizes(), (std::vector<std::int64_t>{5, 3, 33, 47}));
  EXPECT_EQ(pair.frame1.scalar_type(), torch::kUInt8);
  EXPECT_EQ(pair.flow.sizes(), (std::vector<std::int64_t>{5, 2, 33, 47}));
  EXPECT_EQ(pair.occlusion.sizes(), (std::vector<std::int64_t>{5, 1, 33, 47}));
  EXPECT_EQ(pair.occlusion.scalar_type(), torch::kBool);
  EXPECT_LE(pair.layer1.max().item<int>(), 2);
  EXPECT_TRUE(torch::isfinite(pair.flow).all().item<bool>());
  EXPECT_EQ(generator.generate(1, 1, 1, 0).flow.numel(), 2);
}

TEST(PairGenerator, FlowMagnitudesFollowTheChosenDistribution) {
  auto config = clean_config();
  config.layers = 0;
  config.rotation_zoom = 0;
  config.perspective_probability = 0;
  config.nonrigid_probability = 0;
  config.static_probability = 0;
  config.background_ratio = 1.0;
  config.flow_mean_px = 5;
  config.flow_max_px = 1000;
  const auto magnitudes = [&](const std::string& distribution) {
    config.flow_distribution = distribution;
    const PairGenerator generator(config, 1);
    return generator.generate(1200, 1, 1, 3).flow.view({1200, 2}).norm(2, 1);
  };
  const auto exponential = magnitudes("exponential");
  EXPECT_NEAR(exponential.mean().item<float>(), 5.0F, 0.4F);
  EXPECT_NEAR(exponential.std().item<float>(), 5.0F, 0.5F);
  config.flow_max_px = 12;
  const auto uniform = magnitudes("uniform");
  EXPECT_NEAR(uniform.mean().item<float>(), 6.0F, 0.3F);
  EXPECT_LE(uniform.max().item<float>(), 12.001F);
  const auto log_uniform = magnitudes("log_uniform");
  EXPECT_NEAR(log_uniform.log().mean().item<float>(), 0.5F * std::log(0.1F * 12.0F), 0.1F);
}

TEST(PairGenerator, PlatesDoNotMoveWildlyAtTheCorners) {
  auto config = clean_config();
  config.blob_weight = config.polygon_weight = config.bar_weight = 0;
  config.parallax_probability = 0;
  config.perspective_probability = 1;
  config.flow_max_px = 10;
  const PairGenerator generator(config, 1);
  const auto magnitude = generator.generate(32, 72, 96, 4).flow.norm(2, 1);
  // Own translation, the background's, and rotation, zoom, perspective and waves on top.
  EXPECT_LT(magnitude.max().item<float>(), 6 * 10.0F);
}

TEST(PairGenerator, RefusesImpossibleOptions) {
  SceneConfig config;
  config.bank_size = 2;
  config.texture_size = 32;
  const PairGenerator generator(config);
  EXPECT_THROW((void)generator.generate(0, 8, 8, 1), Error);
  EXPECT_THROW((void)generator.generate(1, 8, 0, 1), Error);
  EXPECT_THROW((void)generator.generate(1, 8, 8, 1, -1.0), Error);
  EXPECT_THROW((void)generator.generate(1, 8, 8, 1, std::nan("")), Error);
  EXPECT_THROW(PairGenerator(config, 0, torch::kCPU, torch::zeros({2, 3, 16, 16}, torch::kUInt8)), Error);
  config.flow_distribution = "exponentail";
  try {
    const PairGenerator refused(config);
    FAIL() << "did not throw";
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("did you mean 'exponential'"), std::string::npos) << error.what();
  }
}

TEST(LayerMotion, MapsAreInverseToEachOther) {
  SceneConfig config;
  config.perspective_probability = 1;
  config.nonrigid_probability = 1;
  config.flow_mean_px = 8;
  Random random(5);
  const auto radius = random.uniform({4, 3}, 10, 40);
  const LayerPlacement place{torch::full({4, 3}, 40.0F), torch::full({4, 3}, 30.0F), radius, radius.clamp_min(50.0)};
  const auto motion = draw_motion(config, place, 60, 80, random);
  const auto x = torch::arange(80, torch::kFloat32).view({1, 1, -1}).expand({12, 60, 80});
  const auto y = torch::arange(60, torch::kFloat32).view({1, -1, 1}).expand({12, 60, 80});
  const auto there = motion.to_frame2({x, y});
  const auto back = motion.to_frame1(there);
  EXPECT_TRUE(motion.nonrigid);
  EXPECT_GT((there.x - x).abs().max().item<float>(), 2.0F);
  EXPECT_LT((back.x - x).abs().max().item<float>(), 2e-3F);
  EXPECT_LT((back.y - y).abs().max().item<float>(), 2e-3F);
}

TEST(ShapeSet, ThinBarsKeepTheirWidth) {
  SceneConfig config;
  config.blob_weight = config.polygon_weight = config.plate_weight = 0;
  Random random(2);
  const ShapeSet shapes(config, 32, random);
  const auto axis = torch::linspace(-1.2, 1.2, 601);
  const auto x = axis.view({1, 1, -1}).expand({32, 601, 601}), y = axis.view({1, -1, 1}).expand({32, 601, 601});
  const auto peak = shapes.signed_distance(x, y).flatten(1).amax(1);
  // The ridge of the trunk is its half thickness, drawn from [0.015, 0.12].
  EXPECT_GT(peak.min().item<float>(), 0.01F);
  EXPECT_LT(peak.max().item<float>(), 0.121F);
}

TEST(Photometric, MotionBlurOfAnImpulseIsALineAlongTheMotion) {
  auto image = torch::zeros({1, 3, 15, 31});
  image.select(2, 7).select(2, 15).fill_(1.0);
  const auto vx = torch::full({1, 15, 31}, 12.0), vy = torch::zeros({1, 15, 31});
  const auto blurred = motion_blur(image, vx, vy, torch::tensor({0.5F}));
  const auto row = blurred[0][0][7];
  EXPECT_NEAR(row.sum().item<float>(), 1.0F, 1e-4F);
  EXPECT_GT(row[13].item<float>(), 0.05F);
  EXPECT_NEAR(row[20].item<float>(), 0.0F, 1e-6F);
  EXPECT_NEAR(blurred[0][0][6].sum().item<float>(), 0.0F, 1e-6F);
  EXPECT_TRUE(torch::equal(motion_blur(image, vx, vy, torch::tensor({0.0F})), image));
}

TEST(Photometric, DefocusKeepsMeanAndHasTheGivenSigma) {
  auto image = torch::zeros({1, 3, 21, 21});
  image.select(2, 10).select(2, 10).fill_(1.0);
  const auto blurred = defocus(image, torch::tensor({1.2F}))[0][0];
  const auto offset = torch::arange(21, torch::kFloat32) - 10;
  EXPECT_NEAR(blurred.sum().item<float>(), 1.0F, 1e-5F);
  EXPECT_NEAR((blurred.sum(0) * offset.square()).sum().item<float>(), 1.44F, 0.03F);
}

}  // namespace
}  // namespace ajna::synth
