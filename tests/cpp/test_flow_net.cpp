// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <string>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/nn/flow_net.hpp"

namespace ajna::nn {
namespace {

NetConfig narrow() {
  NetConfig config;
  config.width = 4;
  return config;
}

FlowNet seeded(const NetConfig& config, std::uint64_t seed) {
  torch::manual_seed(seed);
  return FlowNet(config);
}

std::string message_of(const NetConfig& config) {
  try {
    const FlowNet net(config);
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    return error.what();
  }
  return "";
}

TEST(FlowNet, HasThePapersParameterCount) {
  EXPECT_EQ(count_parameters(*FlowNet()), 2724980);
  NetConfig grey;
  grey.in_channels = grey.out_channels = 1;
  EXPECT_EQ(count_parameters(*FlowNet(grey)), 2714785);  // the figure in EVPropNet's logs
}

TEST(FlowNet, CostsThePapersOperations) {
  const double gflop = 2.0 * static_cast<double>(count_macs(NetConfig{}, 240, 320)) / 1e9;
  EXPECT_NEAR(gflop, 6.33, 0.005);
  EXPECT_EQ(count_macs(NetConfig{}, 240, 320), count_macs(NetConfig{}, 320, 240));
  // Cost follows the padded size.
  EXPECT_EQ(count_macs(NetConfig{}, 225, 305), count_macs(NetConfig{}, 240, 320));
}

/// Multiply-accumulates of one forward pass, from the network's own weights: independent of the layer table.
std::int64_t macs_from_weights(const FlowNet& net, std::int64_t height, std::int64_t width) {
  const auto parameters = net->named_parameters();
  std::int64_t total = 0;
  for (const std::string list : {"encoder", "decoder"}) {
    const auto count = static_cast<std::int64_t>(net->named_children()[list]->children().size());
    for (std::int64_t i = 0; i < count; ++i) {
      const auto prefix = list + "." + std::to_string(i) + ".";
      if (const auto* first = parameters.find(prefix + "conv1.weight")) {
        total += 2 * first->numel() * height * width;
        continue;
      }
      const auto weights = parameters[prefix + "conv.weight"].numel();
      if (list == "encoder") {
        height /= 2, width /= 2;
        total += weights * height * width;
      } else {
        total += weights * height * width;
        if (i + 1 < count) {  // the last one keeps the size
          height *= 2, width *= 2;
        }
      }
    }
  }
  return total;
}

TEST(FlowNet, CountedOperationsAgreeWithTheWeights) {
  for (const auto& [width, sub_blocks] : {std::pair{32, 2}, {8, 1}, {4, 3}, {6, 0}}) {
    NetConfig config;
    config.width = width;
    config.sub_blocks = sub_blocks;
    EXPECT_EQ(count_macs(config, 64, 96), macs_from_weights(FlowNet(config), 64, 96)) << width << " " << sub_blocks;
  }
}

class FlowNetSize : public testing::TestWithParam<std::pair<std::int64_t, std::int64_t>> {};

TEST_P(FlowNetSize, OutputIsAsLargeAsTheInput) {
  const auto [height, width] = GetParam();
  auto net = seeded(narrow(), 1);
  net->eval();
  const torch::NoGradGuard no_grad;
  const auto output = net->forward(torch::rand({2, 6, height, width}));
  EXPECT_EQ(output.sizes(), (std::vector<std::int64_t>{2, 4, height, width}));
  EXPECT_TRUE(output.isfinite().all().item<bool>());
}

INSTANTIATE_TEST_SUITE_P(AnySize, FlowNetSize,
                         testing::Values(std::pair{1, 1}, std::pair{17, 31}, std::pair{16, 16}, std::pair{15, 33},
                                         std::pair{1, 40}, std::pair{50, 2}, std::pair{64, 48}));

TEST(FlowNet, PadsByReplicationAndCrops) {
  auto net = seeded(narrow(), 2);
  net->eval();
  const torch::NoGradGuard no_grad;
  const auto x = torch::rand({1, 6, 17, 31});
  namespace F = torch::nn::functional;
  const auto padded = F::pad(x, F::PadFuncOptions({0, 1, 0, 15}).mode(torch::kReplicate));
  const auto expected = net->forward_aligned(padded).slice(2, 0, 17).slice(3, 0, 31);
  EXPECT_TRUE(torch::equal(net->forward(x), expected));
}

TEST(FlowNet, EqualSeedsGiveEqualOutputs) {
  const auto x = torch::rand({1, 6, 32, 32});
  auto a = seeded(narrow(), 7), b = seeded(narrow(), 7), c = seeded(narrow(), 8);
  a->eval(), b->eval(), c->eval();
  EXPECT_TRUE(torch::equal(a->forward(x), b->forward(x)));
  EXPECT_FALSE(torch::equal(a->forward(x), c->forward(x)));
}

TEST(FlowNet, TrainingModeUsesAndUpdatesBatchStatistics) {
  auto net = seeded(narrow(), 3);
  const auto x = torch::randn({4, 6, 32, 32});
  net->eval();
  const auto before = net->forward(x).detach();
  net->train();
  const auto training = net->forward(x).detach();
  EXPECT_FALSE(torch::allclose(before, training, 1e-3, 1e-3));
  net->eval();
  const auto after = net->forward(x).detach();
  EXPECT_FALSE(torch::equal(before, after)) << "running statistics must have moved";
  EXPECT_TRUE(torch::equal(after, net->forward(x))) << "and must stand still in evaluation mode";
}

TEST(FlowNet, EvaluationResultsDoNotDependOnTheBatch) {
  auto net = seeded(narrow(), 4);
  net->eval();
  const torch::NoGradGuard no_grad;
  const auto x = torch::rand({3, 6, 32, 48});
  const auto batch = net->forward(x);
  for (std::int64_t i = 0; i < 3; ++i) {
    EXPECT_TRUE(torch::allclose(batch.slice(0, i, i + 1), net->forward(x.slice(0, i, i + 1)), 1e-5, 1e-6));
  }
}

TEST(FlowNet, EveryParameterGetsAGradient) {
  auto net = seeded(narrow(), 5);
  net->forward(torch::rand({2, 6, 32, 32})).square().mean().backward();
  for (const auto& item : net->named_parameters()) {
    ASSERT_TRUE(item.value().grad().defined()) << item.key();
    EXPECT_TRUE(item.value().grad().isfinite().all().item<bool>()) << item.key();
  }
}

TEST(FlowNet, OptionsOutOfRangeAreNamed) {
  const auto with = [](std::int64_t NetConfig::*field, std::int64_t value) {
    NetConfig config;
    config.*field = value;
    return config;
  };
  EXPECT_NE(message_of(with(&NetConfig::width, 7)).find("width = 7"), std::string::npos);
  EXPECT_NE(message_of(with(&NetConfig::width, 0)).find("width = 0"), std::string::npos);
  EXPECT_NE(message_of(with(&NetConfig::expansion, 5)).find("expansion = 5"), std::string::npos);
  EXPECT_NE(message_of(with(&NetConfig::sub_blocks, -1)).find("sub_blocks = -1"), std::string::npos);
  EXPECT_NE(message_of(with(&NetConfig::in_channels, 0)).find("in_channels = 0"), std::string::npos);
  EXPECT_NE(message_of(with(&NetConfig::out_channels, 0)).find("out_channels = 0"), std::string::npos);
  EXPECT_EQ(message_of(with(&NetConfig::sub_blocks, 0)), "");
}

TEST(FlowNet, InputsThatDoNotFitAreNamed) {
  auto net = FlowNet(narrow());
  const std::vector<torch::Tensor> wrong = {torch::rand({1, 3, 16, 16}), torch::rand({6, 16, 16}),
                                            torch::zeros({1, 6, 16, 16}, torch::kByte), torch::rand({1, 6, 0, 16})};
  for (const auto& x : wrong) {
    try {
      net->forward(x);
      ADD_FAILURE() << "accepted " << x.sizes();
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
      EXPECT_NE(std::string(error.what()).find("[N, 6, H, W]"), std::string::npos) << error.what();
    }
  }
}

}  // namespace
}  // namespace ajna::nn
