// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "ajna/nn/preprocess.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using ajna::testing::expect_error;

TEST(NetworkInput, MapsBytesToPlusMinusOneAndStacksFrames) {
  const auto values = torch::arange(256, torch::kUInt8).view({1, 1, 16, 16});
  const auto frame1 = values.expand({2, 3, 16, 16}), frame2 = 255 - frame1;
  const auto x = network_input(frame1, frame2);
  ASSERT_EQ(x.sizes(), torch::IntArrayRef({2, 6, 16, 16}));
  EXPECT_EQ(x.scalar_type(), torch::kFloat32);
  EXPECT_TRUE(x.slice(1, 0, 3).equal(frame1.to(torch::kFloat32) / 127.5 - 1.0));
  EXPECT_TRUE(x.slice(1, 3, 6).equal(frame2.to(torch::kFloat32) / 127.5 - 1.0));
  EXPECT_FLOAT_EQ(x.min().item<float>(), -1.0F);
  EXPECT_FLOAT_EQ(x.max().item<float>(), 1.0F);
}

TEST(NetworkInput, FloatFramesOfEqualValueGiveTheSame) {
  const auto frame = torch::randint(256, {1, 3, 5, 7}, torch::kUInt8);
  const auto expected = network_input(frame, frame);
  EXPECT_TRUE(network_input(frame.to(torch::kFloat32), frame.to(torch::kFloat64)).allclose(expected));
  // The caller's float frame is read, not written.
  const auto given = frame.to(torch::kFloat32);
  network_input(given, given);
  EXPECT_TRUE(given.equal(frame.to(torch::kFloat32)));
}

TEST(NetworkInput, RefusesWhatIsNotAPairOfRgbFrames) {
  const auto good = torch::zeros({1, 3, 4, 4}, torch::kUInt8);
  const auto refused = [&](const std::string& part, const torch::Tensor& a, const torch::Tensor& b) {
    expect_error(ErrorKind::kInvalidArgument, part, [&] { network_input(a, b); });
  };
  refused("frame 1 of shape [3, 4, 4]", good[0], good);
  refused("frame 2 of shape [1, 1, 4, 4]", good, good.slice(1, 0, 1));
  refused("differ in shape", good, torch::zeros({1, 3, 4, 5}, torch::kUInt8));
  refused("Long", good.to(torch::kInt64), good);
  refused("(none)", torch::Tensor(), good);
}

}  // namespace
}  // namespace ajna::nn
