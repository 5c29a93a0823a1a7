// SPDX-License-Identifier: MIT
// The network with skip connections, heads at several scales and a correlation volume: each through the whole chain of
// training, checkpoint, TorchScript and engine.
#include <gtest/gtest.h>
#include <torch/script.h>

#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "ajna/nn/flow_graph.hpp"
#include "ajna/nn/folded_net.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/torchscript.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using namespace ajna::testing;

NetConfig variant(std::int64_t skips, std::int64_t heads, std::int64_t radius, NetConfig config = {}) {
  config.skip_connections = skips;
  config.scale_heads = heads;
  config.correlation_radius = radius;
  return config;
}

NetConfig narrow(std::int64_t sub_blocks = 2) {
  NetConfig config;
  config.width = 8;
  config.sub_blocks = sub_blocks;
  return config;
}

const std::vector<NetConfig> kVariants = {variant(1, 0, 0, narrow()),  variant(0, 1, 0, narrow()),
                                          variant(0, 0, 2, narrow()),  variant(1, 1, 2, narrow()),
                                          variant(1, 1, 0, narrow(0)), variant(1, 1, 1, narrow(1))};

std::string label(const NetConfig& c) {
  return "skips " + std::to_string(c.skip_connections) + ", heads " + std::to_string(c.scale_heads) + ", radius " +
         std::to_string(c.correlation_radius) + ", sub-blocks " + std::to_string(c.sub_blocks);
}

TEST(FlowVariants, StayWithinTheBudgetAtFullSize) {
  for (const auto& config :
       {variant(1, 0, 0), variant(0, 1, 0), variant(1, 1, 0), variant(0, 0, 4), variant(1, 0, 4)}) {
    EXPECT_LE(count_parameters(config), 2'800'000) << label(config);
    EXPECT_LE(2e-9 * static_cast<double>(count_macs(config, 240, 320)), 7.0) << label(config);
  }
  // A skip connection has channels x channels weights and a bias each; a head 3 x 3 x channels x 4 weights, 4 biases.
  EXPECT_EQ(count_parameters(variant(1, 0, 0)) - count_parameters(NetConfig{}), (32 * 32 + 32) + (64 * 64 + 64));
  EXPECT_EQ(count_macs(variant(1, 0, 0), 240, 320) - count_macs(NetConfig{}, 240, 320),
            32 * 32 * 120 * 160 + 64 * 64 * 60 * 80);
  EXPECT_EQ(count_parameters(variant(0, 1, 0)) - count_parameters(NetConfig{}), (9 * 64 * 4 + 4) + (9 * 32 * 4 + 4));
  EXPECT_EQ(count_macs(variant(0, 1, 0), 240, 320) - count_macs(NetConfig{}, 240, 320),
            9 * 64 * 4 * 60 * 80 + 9 * 32 * 4 * 120 * 160);
}

TEST(FlowVariants, CountsAgreeWithTheBuiltNetwork) {
  for (const auto& config : kVariants) {
    EXPECT_EQ(count_parameters(*FlowNet(config)), count_parameters(config)) << label(config);
  }
  // 7x7, 5x5, 3x3 at 1/2, 1/4, 1/8 of the size, twice; then 25 scalar products over 16 channels, and their way on.
  const std::int64_t stem = 49 * 3 * 4 * 32 * 48 + 25 * 4 * 8 * 16 * 24 + 9 * 8 * 16 * 8 * 12;
  EXPECT_EQ(count_macs(variant(0, 0, 2, narrow()), 64, 96) - count_macs(narrow(), 64, 96),
            2 * stem + (25 * 16 + 25 * 32) * 8 * 12);
}

TEST(FlowVariants, CorrelationIsTheScalarProductAtEachDisplacement) {
  torch::manual_seed(1);
  const auto a = torch::randn({2, 5, 4, 6}), b = torch::randn({2, 5, 4, 6});
  const std::int64_t radius = 2, side = 2 * radius + 1;
  const auto result = correlation(a, b, radius);
  ASSERT_EQ(result.sizes(), (std::vector<std::int64_t>{2, side * side, 4, 6}));
  for (std::int64_t n = 0; n < 2; ++n) {
    for (std::int64_t dy = -radius; dy <= radius; ++dy) {
      for (std::int64_t dx = -radius; dx <= radius; ++dx) {
        for (std::int64_t y = 0; y < 4; ++y) {
          for (std::int64_t x = 0; x < 6; ++x) {
            const bool inside = y + dy >= 0 && y + dy < 4 && x + dx >= 0 && x + dx < 6;
            const double expected = inside ? torch::dot(a.select(0, n).select(1, y).select(1, x),
                                                        b.select(0, n).select(1, y + dy).select(1, x + dx))
                                                     .item<double>() /
                                                 std::sqrt(5.0)
                                           : 0.0;
            const auto channel = (dy + radius) * side + dx + radius;
            ASSERT_NEAR(result.index({n, channel, y, x}).item<double>(), expected, 1e-5)
                << n << " " << dy << " " << dx << " " << y << " " << x;
          }
        }
      }
    }
  }
}

TEST(FlowVariants, ScalesCorrectEachOther) {
  auto net = small_net(variant(1, 1, 2, narrow()));
  const torch::NoGradGuard no_grad;
  const auto x = torch::rand({2, 6, 32, 48});
  const auto scales = net->forward_scales(x);
  ASSERT_EQ(scales.size(), 3U);
  EXPECT_EQ(scales[0].sizes(), (std::vector<std::int64_t>{2, 4, 8, 12}));
  EXPECT_EQ(scales[1].sizes(), (std::vector<std::int64_t>{2, 4, 16, 24}));
  EXPECT_TRUE(torch::equal(scales[2], net->forward(x)));
  EXPECT_TRUE(torch::equal(net->forward_layers(x).back(), scales[2]));
  // With the finer corrections at zero, what is left is the coarse prediction, enlarged.
  for (const auto& parameter : net->named_parameters()) {
    if (parameter.key().rfind("heads.1.", 0) == 0 || parameter.key().rfind("decoder.6.", 0) == 0) {
      parameter.value().zero_();
    }
  }
  namespace F = torch::nn::functional;
  const auto size = F::InterpolateFuncOptions().mode(torch::kBilinear).align_corners(false);
  auto expected = F::interpolate(scales[0], F::InterpolateFuncOptions(size).scale_factor(std::vector<double>{2., 2.}));
  expected = F::interpolate(expected, F::InterpolateFuncOptions(size).scale_factor(std::vector<double>{2., 2.}));
  EXPECT_TRUE(torch::allclose(net->forward(x), expected, 1e-5, 1e-6));
  EXPECT_EQ(FlowNet(narrow())->forward_scales(x).size(), 1U);
}

TEST(FlowVariants, SkipConnectionsCarryTheEncodersOutputs) {
  auto net = small_net(variant(1, 0, 0, narrow()));
  const torch::NoGradGuard no_grad;
  const auto x = torch::rand({1, 6, 32, 32});
  const auto layers = net->forward_layers(x);  // 6 of the encoder, 7 of the decoder
  ASSERT_EQ(layers.size(), 13U);
  // Without its own weights a decoder layer hands on what the encoder gave at that size (1/4, 1/2), by the 1x1 kernel.
  struct Place {
    std::string decoder;
    std::size_t encoder;
    std::string skip;
  };
  for (const auto& place : std::vector<Place>{{"3", 1, "1"}, {"4", 0, "0"}}) {
    auto blank = small_net(variant(1, 0, 0, narrow()));
    torch::Tensor weight, bias;
    for (const auto& parameter : blank->named_parameters()) {
      if (parameter.key().rfind("decoder." + place.decoder + ".", 0) == 0) {
        parameter.value().zero_();
      } else if (parameter.key() == "skips." + place.skip + ".conv.weight") {
        weight = parameter.value();
      } else if (parameter.key() == "skips." + place.skip + ".conv.bias") {
        bias = parameter.value();
      }
    }
    ASSERT_TRUE(weight.defined() && bias.defined()) << place.skip;
    const auto carried = layers[place.encoder];
    const auto expected = torch::einsum("oi,nihw->nohw", {weight.flatten(1), carried}) + bias.view({1, -1, 1, 1});
    const auto given = blank->forward_layers(x)[6 + std::stoul(place.decoder)];
    EXPECT_TRUE(torch::allclose(given, expected, 1e-5, 1e-6)) << place.decoder;
  }
}

TEST(FlowVariants, EveryParameterGetsAGradientFromTheScales) {
  for (const auto& config : kVariants) {
    torch::manual_seed(5);
    FlowNet net(config);
    torch::Tensor loss = torch::zeros({});
    for (const auto& scale : net->forward_scales(torch::rand({2, 6, 32, 32}))) {
      loss = loss + scale.square().mean();
    }
    loss.backward();
    for (const auto& item : net->named_parameters()) {
      ASSERT_TRUE(item.value().grad().defined()) << label(config) << ": " << item.key();
      EXPECT_TRUE(item.value().grad().isfinite().all().item<bool>()) << item.key();
    }
  }
}

TEST(FlowVariants, CheckpointScriptAndFoldedNetworkGiveTheSame) {
  for (const auto& config : kVariants) {
    const TemporaryFolder folder;
    auto net = small_net(config);
    const auto metadata = small_metadata(*net);
    save_checkpoint(folder.file("m.safetensors"), *net, metadata);
    auto loaded = load_checkpoint(folder.file("m.safetensors"));
    EXPECT_EQ(loaded.metadata.net, config) << label(config);
    export_torchscript(*net, metadata, folder.file("m.pt"));
    auto script = torch::jit::load(folder.file("m.pt"));
    const FoldedNet folded(*net, torch::kCPU, torch::kFloat32);
    const torch::NoGradGuard no_grad;
    for (const auto& [height, width] : std::vector<std::pair<std::int64_t, std::int64_t>>{{32, 32}, {50, 37}, {1, 1}}) {
      const auto frames = torch::randint(256, {2, 2, 3, height, width}, torch::kUInt8);
      const auto x = network_input(frames[0], frames[1]);
      const auto expected = net->forward(x);
      const double scale = expected.abs().max().item<double>();
      const auto difference = [&](const torch::Tensor& y) { return (y - expected).abs().max().item<double>() / scale; };
      EXPECT_EQ(difference(loaded.net->forward(x)), 0.0) << label(config);
      EXPECT_LE(difference(script.forward({x}).toTensor()), 1e-5) << label(config) << " " << height << "x" << width;
      EXPECT_LE(difference(folded.forward(x)), 1e-4) << label(config) << " " << height << "x" << width;
    }
  }
}

TEST(FlowVariants, FilesOfThePlainNetworkKeepTheirForm) {
  const auto strings = metadata_to_strings(small_metadata(*small_net()));
  for (const auto* key : {"net.skip_connections", "net.scale_heads", "net.correlation_radius"}) {
    EXPECT_EQ(strings.count(key), 0U) << key;
  }
}

TEST(FlowVariants, OptionsOutOfRangeAreNamed) {
  const auto build = [](const NetConfig& config) { return [config] { const FlowNet net(config); }; };
  expect_error(ErrorKind::kInvalidArgument, "skip_connections = 2", build(variant(2, 0, 0)));
  expect_error(ErrorKind::kInvalidArgument, "scale_heads = -1", build(variant(0, -1, 0)));
  expect_error(ErrorKind::kInvalidArgument, "correlation_radius = 9", build(variant(0, 0, 9)));
  expect_error(ErrorKind::kInvalidArgument, "correlation_radius = 1", build(variant(0, 0, 1, narrow(0))));
  NetConfig odd = variant(0, 0, 1);
  odd.in_channels = 5;
  expect_error(ErrorKind::kInvalidArgument, "even number of input channels", build(odd));
}

}  // namespace
}  // namespace ajna::nn
