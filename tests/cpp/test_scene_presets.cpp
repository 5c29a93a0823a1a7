// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <torch/torch.h>

#include <cmath>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/synth/camera_motion.hpp"
#include "ajna/synth/presets.hpp"
#include "ajna/synth/scene.hpp"
#include "synth_checks.hpp"

namespace ajna::synth {
namespace {

using torch::Tensor;

class EveryPreset : public ::testing::TestWithParam<std::string> {};

std::vector<std::string> preset_names() {
  std::vector<std::string> names;
  for (const auto& preset : scene_presets()) {
    names.push_back(preset.name);
  }
  return names;
}

INSTANTIATE_TEST_SUITE_P(Scenes, EveryPreset, ::testing::ValuesIn(preset_names()),
                         [](const auto& test) { return test.param; });

TEST_P(EveryPreset, WarpingFrame2ReproducesFrame1OnVisiblePixels) {
  const PairGenerator generator(testing::cleaned(scene_preset(GetParam()).config), 3);
  const auto pair = generator.generate(8, 96, 128, 11);
  const auto error = (testing::warp(pair.frame2, pair.flow) - pair.frame1.to(torch::kFloat32)).abs().mean(1, true);
  const auto edges = pair.layer1.to(torch::kFloat32);
  const auto flat =
      testing::F::max_pool2d(edges, testing::F::MaxPool2dFuncOptions(3).stride(1).padding(1)) - edges < 0.5;
  const auto interior = testing::eroded(pair.occlusion.logical_not().logical_and(flat), 1);
  ASSERT_GT(interior.to(torch::kFloat32).mean().item<float>(), 0.25F);
  const auto inside = error.masked_select(interior);
  EXPECT_LT(inside.median().item<float>(), 1.0F);
  EXPECT_LT(inside.mean().item<float>(), 3.0F);
}

TEST_P(EveryPreset, OcclusionAgreesWithBruteForceVisibility) {
  const PairGenerator generator(testing::cleaned(scene_preset(GetParam()).config), 7);
  const auto [compared, hidden, wrong] = testing::check_occlusion(generator.generate(12, 96, 128, 21, 2.0));
  EXPECT_GT(compared, 20000);
  EXPECT_GT(hidden, 100);
  // A twig thinner than a pixel may pass between the grid points of layer2.
  EXPECT_LE(wrong * 50, hidden) << wrong << " of " << compared << " compared pixels, " << hidden << " hidden";
}

TEST_P(EveryPreset, EqualSeedsGiveEqualBitsAndTheWholeRangeIsValid) {
  auto config = scene_preset(GetParam()).config;
  config.bank_size = 6;
  config.texture_size = 64;
  const PairGenerator first(config, 4), second(config, 4);
  const auto a = first.generate(3, 40, 56, 17), b = second.generate(3, 40, 56, 17);
  for (const auto member : {&PairBatch::frame1, &PairBatch::frame2, &PairBatch::flow, &PairBatch::occlusion,
                            &PairBatch::motion_boundary, &PairBatch::layer1, &PairBatch::layer2}) {
    EXPECT_TRUE(torch::equal(a.*member, b.*member));
  }
  EXPECT_TRUE(torch::isfinite(a.flow).all().item<bool>());
  EXPECT_LT(first.generate(3, 40, 56, 17, 0.0).flow.abs().max().item<float>(), 1e-3F);
}

TEST(ScenePresets, TheFirstHasTheDefaultsAndUnknownNamesAreRefused) {
  const auto& general = scene_presets().front();
  EXPECT_EQ(general.name, "general");
  EXPECT_EQ(general.config.layers, SceneConfig{}.layers);
  for (const auto& preset : scene_presets()) {
    EXPECT_NO_THROW(validate(preset.config)) << preset.name;
    EXPECT_FALSE(preset.summary.empty());
  }
  try {
    (void)scene_preset("doge");
    FAIL() << "did not throw";
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("did you mean 'dodge'"), std::string::npos) << error.what();
  }
}

/// Flow of each layer at pixels [H, W] by its homography: [B, L, 2, H, W] float64.
Tensor homography_flow(const Tensor& homographies, const Tensor& u, const Tensor& v) {
  const auto h = [&](int r, int c) { return homographies.select(2, r).select(2, c).unsqueeze(-1).unsqueeze(-1); };
  const auto w = h(2, 0) * u + h(2, 1) * v + h(2, 2);
  return torch::stack({(h(0, 0) * u + h(0, 1) * v + h(0, 2)) / w - u, (h(1, 0) * u + h(1, 1) * v + h(1, 2)) / w - v},
                      2);
}

struct Rays {
  Tensor u, v, x, y;  // pixels, normalised
};

Rays rays(const SceneGeometry& g, std::int64_t height, std::int64_t width) {
  Rays r;
  r.u = torch::arange(width, torch::kFloat64).view({1, 1, 1, -1});
  r.v = torch::arange(height, torch::kFloat64).view({1, 1, -1, 1});
  const auto f = g.focal_px.view({-1, 1, 1, 1});
  r.x = (r.u - g.center_x) / f;
  r.y = (r.v - g.center_y) / f;
  return r;
}

SceneConfig camera_config(const std::string& surface) {
  SceneConfig config;
  config.layers = 4;
  config.camera = "any";
  config.surface = surface;
  config.static_probability = 0;
  config.nonrigid_probability = 0;
  return config;
}

class EverySurface : public ::testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Camera, EverySurface, ::testing::Values("wall", "floor", "table"),
                         [](const auto& test) { return test.param; });

TEST_P(EverySurface, SmallStepsGiveTheMotionFieldOfEquation14) {
  Random random(3);
  const std::int64_t height = 30, width = 40;
  const auto g = draw_geometry(camera_config(GetParam()), 3, height, width, random);
  const auto r = rays(g, height, width);
  const auto m = [&](int k) { return g.plane.select(2, k).unsqueeze(-1).unsqueeze(-1); };
  const auto inverse_depth = m(0) * r.x + m(1) * r.y + m(2);
  const double small = 1e-6;
  const CameraStep step{small * random.normal({3, 3}).to(torch::kFloat64),
                        small * random.normal({3, 3}).to(torch::kFloat64)};
  const auto each = [&](const Tensor& t, int k) { return t.select(1, k).view({-1, 1, 1, 1}); };
  const auto vx = each(step.translation, 0), vy = each(step.translation, 1), vz = each(step.translation, 2);
  const auto wx = each(step.rotation, 0), wy = each(step.rotation, 1), wz = each(step.rotation, 2);
  const auto flow_x = inverse_depth * (r.x * vz - vx) + r.x * r.y * wx - (1 + r.x * r.x) * wy + r.y * wz;
  const auto flow_y = inverse_depth * (r.y * vz - vy) + (1 + r.y * r.y) * wx - r.x * r.y * wy - r.x * wz;
  const auto expected = torch::stack({flow_x, flow_y}, 2) * g.focal_px.view({-1, 1, 1, 1, 1});
  const auto flow = homography_flow(step_homographies(g, step), r.u, r.v);
  ASSERT_GT(expected.abs().max().item<double>(), 1e-5);
  EXPECT_LT((flow - expected).abs().max().item<double>(), 1e-4 * expected.abs().max().item<double>());
}

TEST_P(EverySurface, LargeStepsProjectThePointsOfThePlanes) {
  Random random(5);
  const std::int64_t height = 30, width = 40;
  const auto g = draw_geometry(camera_config(GetParam()), 2, height, width, random);
  const auto step = draw_camera_step(camera_config(GetParam()), g, torch::tensor({6.0F, 20.0F}), random);
  const auto flow = homography_flow(step_homographies(g, step), rays(g, height, width).u, rays(g, height, width).v);
  std::int64_t compared = 0;
  for (std::int64_t b = 0; b < 2; ++b) {
    // Rodrigues' formula, written out.
    const auto w = step.rotation[b];
    const double angle = w.norm().item<double>();
    const auto k = w / angle;
    for (std::int64_t layer = 0; layer < g.plane.size(1); ++layer) {
      for (std::int64_t v = 0; v < height; v += 7) {
        for (std::int64_t u = 0; u < width; u += 7) {
          const double f = g.focal_px[b].item<double>();
          const auto ray =
              torch::tensor({(static_cast<double>(u) - g.center_x) / f, (static_cast<double>(v) - g.center_y) / f, 1.0},
                            torch::kFloat64);
          const double inverse_depth = g.plane[b][layer].dot(ray).item<double>();
          if (inverse_depth < 1e-3) {
            continue;  // above the floor's horizon
          }
          const auto from = ray / inverse_depth - step.translation[b];
          const auto seen = from * std::cos(angle) - torch::linalg_cross(k, from) * std::sin(angle) +
                            k * k.dot(from) * (1 - std::cos(angle));
          ASSERT_GT(seen[2].item<double>(), 0.0);
          const double to_u = (f * seen[0] / seen[2]).item<double>() + g.center_x;
          const double to_v = (f * seen[1] / seen[2]).item<double>() + g.center_y;
          EXPECT_NEAR(flow[b][layer][0][v][u].item<double>(), to_u - static_cast<double>(u), 1e-8);
          EXPECT_NEAR(flow[b][layer][1][v][u].item<double>(), to_v - static_cast<double>(v), 1e-8);
          ++compared;
        }
      }
    }
  }
  EXPECT_GT(compared, 150);
}

TEST_P(EverySurface, OneCameraTranslationExplainsTheFlowOfAllLayers) {
  // Without rotation flow = zeta ((x + flow) V_z - V_xy) for one V per scene, zeta the inverse depth of what is seen.
  auto config = testing::cleaned(camera_config(GetParam()));
  config.camera_rotation = 0;
  config.flow_mean_px = 6;
  const std::int64_t height = 48, width = 64, batch = 6;
  const PairGenerator generator(config, 1);
  const auto pair = generator.generate(batch, height, width, 8);
  const auto scene = draw_scene(config, generator.bank(), batch, height, width, 8);
  ASSERT_TRUE(scene.geometry.has_value());
  const auto& g = *scene.geometry;
  const auto r = rays(g, height, width);
  int several = 0;
  for (std::int64_t b = 0; b < batch; ++b) {
    const auto m = g.plane[b].index_select(0, pair.layer1[b].reshape({-1}).to(torch::kInt64));
    const auto x = r.x[b][0].expand({height, width}).reshape({-1}), y = r.y[b][0].expand({height, width}).reshape({-1});
    const auto zeta = m.select(1, 0) * x + m.select(1, 1) * y + m.select(1, 2);
    const auto flow = pair.flow[b].to(torch::kFloat64).view({2, -1}) / g.focal_px[b];
    const auto zero = torch::zeros_like(x);
    const auto rows = torch::cat(
        {torch::stack({-zeta, zero, zeta * (x + flow[0])}, 1), torch::stack({zero, -zeta, zeta * (y + flow[1])}, 1)});
    const auto right = torch::cat({flow[0], flow[1]}).unsqueeze(1);
    const auto v = std::get<0>(torch::linalg_lstsq(rows, right, std::nullopt, "gelsd"));
    several += pair.layer1[b].max().item<int>() > pair.layer1[b].min().item<int>() ? 1 : 0;
    const auto residual = (rows.matmul(v) - right).abs().max() * g.focal_px[b];
    EXPECT_LT(residual.item<double>(), 2e-3) << "scene " << b;
  }
  EXPECT_GE(several, 4);
}

TEST(SceneGeometry, TheFloorEndsAtTheHorizonAndTreesStandOnIt) {
  const auto config = scene_preset("navigate").config;
  const TextureBank bank(4, 32, 1, torch::kCPU);
  const std::int64_t batch = 16, height = 96, width = 128;
  const auto scene = draw_scene(config, bank, batch, height, width, 4);
  const auto& g = *scene.geometry;
  // At a tree's foot floor and tree are equally deep.
  const auto upright = scene.shapes.upright().view({batch, scene.layers});
  const auto floor =
      (g.floor_plane.select(1, 1).unsqueeze(1) * (scene.place.center_y - g.center_y) / g.focal_px.unsqueeze(1)) +
      g.floor_plane.select(1, 2).unsqueeze(1);
  auto trees = upright.clone();
  trees.slice(1, 0, 2).fill_(false);
  ASSERT_GT(trees.sum().item<int>(), 100);
  const auto apart = (floor / g.plane.select(2, 2) - 1).abs().masked_select(trees);
  EXPECT_LT(apart.max().item<double>(), 1e-3);
  // Nearer layers come later.
  const auto order = g.plane.slice(1, 2).select(2, 2);
  EXPECT_TRUE((order.slice(1, 1) >= order.slice(1, 0, -1)).all().item<bool>());
  const auto inverse_depth_at_horizon =
      g.floor_plane.select(1, 1) * (g.horizon_y.to(torch::kFloat64) - g.center_y) / g.focal_px +
      g.floor_plane.select(1, 2);
  EXPECT_LT(inverse_depth_at_horizon.abs().max().item<double>(), 1e-3);
}

TEST(ShapeSet, TreesAreUprightAndThin) {
  SceneConfig config;
  config.blob_weight = config.polygon_weight = config.bar_weight = config.plate_weight = 0;
  config.trunk_weight = 1;
  Random random(2);
  const ShapeSet shapes(config, 24, random);
  EXPECT_TRUE(shapes.upright().all().item<bool>());
  const auto x = torch::linspace(-1.0, 1.0, 401).view({1, 1, -1}).expand({24, 60, 401});
  const auto y = torch::linspace(-2.9, 1.0, 60).view({1, -1, 1}).expand({24, 60, 401});
  const auto inside = shapes.signed_distance(x, y) > 0;
  // A trunk at every height above the foot, nothing well below it; the trunk's centre stays near the vertical axis.
  EXPECT_TRUE(inside.slice(1, 0, 44).any(2).all().item<bool>());
  EXPECT_FALSE(inside.slice(1, 48).any().item<bool>());
  const auto below_twigs = inside.slice(1, 35, 44).to(torch::kFloat32);  // y from -0.59 to 0
  const auto center = (below_twigs * x.slice(1, 35, 44)).sum(2) / below_twigs.sum(2);
  EXPECT_LT(center.abs().max().item<float>(), 0.15F);
  EXPECT_LT(below_twigs.sum(2).max().item<float>() * 0.005F, 0.34F);
}

TEST(PairGenerator, BlinkingLayersChangeBrightnessWithoutMotion) {
  auto config = testing::cleaned({});
  config.blink_probability = 1;
  const PairGenerator generator(config, 3);
  const auto pair = generator.generate(6, 48, 64, 5, 0.0);
  EXPECT_LT(pair.flow.abs().max().item<float>(), 1e-4F);
  const auto change = (pair.frame1.to(torch::kFloat32) - pair.frame2.to(torch::kFloat32)).abs().mean(1, true);
  const auto layer = testing::eroded(pair.layer1 > 0, 2), background = testing::eroded(pair.layer1 == 0, 2);
  // Twigs thinner than half a pixel belong to the background and blink.
  EXPECT_LT(change.masked_select(background).mean().item<float>(), 0.5F);
  EXPECT_GT(change.masked_select(layer).mean().item<float>(), 20.0F);
}

TEST(PairGenerator, ExposureJumpsAndLampsChangeOneFrame) {
  auto config = testing::cleaned({});
  const auto means = [&](const SceneConfig& c) {
    const auto pair = PairGenerator(c, 3).generate(24, 32, 40, 5, 0.0);
    const auto mean = [](const Tensor& x) { return x.to(torch::kFloat32).mean({1, 2, 3}); };
    return (mean(pair.frame2) / mean(pair.frame1)).log2().abs();
  };
  EXPECT_LT(means(config).max().item<float>(), 0.02F);
  config.jump_probability = 1;
  EXPECT_GT(means(config).mean().item<float>(), 0.3F);
  EXPECT_LT(means(config).max().item<float>(), 1.7F);
  config.jump_probability = 0;
  config.light_probability = 1;
  EXPECT_GT(means(config).max().item<float>(), 0.03F);
}

TEST(TextureBank, SharesOfFlatAndRepetitiveTextures) {
  const auto detail = [](const TextureMix& mix) {
    const TextureBank bank(24, 64, 2, torch::kCPU, std::nullopt, mix);
    const auto textures = bank.textures();
    return (textures.slice(2, 1) - textures.slice(2, 0, -1)).abs().mean({1, 2, 3}).median().item<float>();
  };
  const float mixed = detail({}), flat = detail({1.0, 0.0}), repetitive = detail({0.0, 1.0});
  EXPECT_LT(flat, 0.5F * mixed);
  EXPECT_GT(repetitive, flat);
}

TEST(PairGenerator, GeneratorsCanShareTheirTextures) {
  SceneConfig config;
  config.bank_size = 6;
  config.texture_size = 64;
  const PairGenerator first(config, 4);
  auto other = scene_preset("gap").config;
  other.bank_size = 6;
  other.texture_size = 64;
  const PairGenerator shared(other, first), own(other, 4);
  EXPECT_EQ(&shared.bank(), &first.bank());
  EXPECT_TRUE(torch::equal(shared.generate(2, 32, 40, 1).frame1, own.generate(2, 32, 40, 1).frame1));
  other.bank_size = 7;
  EXPECT_THROW(PairGenerator(other, first), Error);
}

TEST(PairGenerator, ScenesOfEarlierRunsStayTheSame) {
  // Sums over a batch of default scenes, from before presets existed. A resumed run must see the samples it would have
  // seen: any further draw from the scenes' stream changes all of them. The margin is for other processors' rounding.
  SceneConfig config;
  config.bank_size = 8;
  config.texture_size = 64;
  const auto pair = PairGenerator(config, 5).generate(3, 48, 64, 1);
  const auto sum = [](const Tensor& x) { return x.to(torch::kFloat64).sum().item<double>(); };
  EXPECT_NEAR(sum(pair.frame1), 3041190, 300);
  EXPECT_NEAR(sum(pair.frame2), 2801957, 300);
  EXPECT_NEAR(sum(pair.flow.abs()), 12004.894, 0.5);
  EXPECT_NEAR(sum(pair.occlusion), 652, 3);
  EXPECT_NEAR(sum(pair.motion_boundary), 859, 3);
  EXPECT_NEAR(sum(pair.layer1), 6359, 20);
}

}  // namespace
}  // namespace ajna::synth
