// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <torch/script.h>

#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/safetensors_header.hpp"
#include "ajna/nn/torchscript.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using namespace ajna::testing;

class TorchScriptTest : public ::testing::Test {
 protected:
  void SetUp() override {
    net_ = small_net();
    metadata_ = small_metadata(*net_);
    path_ = folder_.file("model.pt");
  }
  void save() { export_torchscript(*net_, metadata_, path_); }

  TemporaryFolder folder_;
  FlowNet net_{nullptr};
  Metadata metadata_;
  std::string path_;
};

double largest_difference(const torch::Tensor& a, const torch::Tensor& b) {
  EXPECT_EQ(a.sizes(), b.sizes());
  return (a - b).abs().max().item<double>();
}

TEST_F(TorchScriptTest, EqualsTheModuleAtTheExportedAndAtOtherSizes) {
  save();
  auto script = torch::jit::load(path_);
  const torch::NoGradGuard no_grad;
  const std::int64_t stride = metadata_.net.stride();  // exported at twice the stride
  for (const auto& [height, width] : std::vector<std::pair<std::int64_t, std::int64_t>>{
           {2 * stride, 2 * stride}, {5 * stride, 3 * stride}, {37, 61}, {1, 1}, {3, 50}}) {
    for (const std::int64_t batch : {1, 2}) {
      const auto frame1 = torch::randint(256, {batch, 3, height, width}, torch::kUInt8);
      const auto frame2 = torch::randint(256, {batch, 3, height, width}, torch::kUInt8);
      const auto x = network_input(frame1, frame2);
      const auto expected = net_->forward(x);
      // Batch normalisation is folded into the convolutions of the file.
      const double rounding = 3e-6 * expected.abs().max().item<double>();
      EXPECT_LE(largest_difference(script.forward({x}).toTensor(), expected), rounding) << height << "x" << width;

      const auto result = script.get_method("predict")({frame1, frame2}).toTuple();
      const auto values = metadata_.table.evaluate(expected.slice(1, 2, 4));
      const auto& parts = result->elements();
      ASSERT_EQ(parts.size(), 3U);
      EXPECT_LE(largest_difference(parts[0].toTensor(), expected.slice(1, 0, 2) * 2.5), 2.5 * rounding);
      EXPECT_LE(largest_difference(parts[1].toTensor(), values.uncertainty), 10 * rounding);
      EXPECT_LE(largest_difference(parts[2].toTensor(), values.expected_error * 2.5), 10 * rounding);
    }
  }
}

TEST_F(TorchScriptTest, CarriesTheMetadata) {
  save();
  torch::jit::ExtraFilesMap files{{kScriptMetadataFile, ""}};
  torch::jit::load(path_, torch::kCPU, files);
  const auto strings = parse_string_map(files[kScriptMetadataFile]);
  EXPECT_EQ(strings, metadata_to_strings(metadata_));
  EXPECT_EQ(metadata_from_strings(strings).provenance, metadata_.provenance);
}

TEST_F(TorchScriptTest, LeavesTheNetworkAndTheRandomStateAlone) {
  net_->train();
  net_->parameters()[0].mutable_grad() = torch::ones_like(net_->parameters()[0]);
  std::vector<torch::Tensor> before;
  for (const auto& tensor : net_->buffers()) {
    before.push_back(tensor.clone());
  }
  const auto random = at::detail::getDefaultCPUGenerator().get_state();
  save();
  EXPECT_TRUE(random.equal(at::detail::getDefaultCPUGenerator().get_state()));
  EXPECT_TRUE(net_->is_training());
  EXPECT_TRUE(net_->parameters()[0].grad().defined());
  for (std::size_t i = 0; i < before.size(); ++i) {
    EXPECT_TRUE(net_->buffers()[i].equal(before[i])) << i;
  }
}

TEST_F(TorchScriptTest, IsFrozenAndWeighsLittleMoreThanTheWeights) {
  save();
  auto script = torch::jit::load(path_);
  EXPECT_EQ(script.parameters().size(), 0U);
  const auto weights = static_cast<std::uintmax_t>(count_parameters(metadata_.net)) * sizeof(float);
  EXPECT_LT(std::filesystem::file_size(path_), weights + 60000);
}

TEST_F(TorchScriptTest, ScriptRefusesWrongInputInItsOwnWords) {
  save();
  auto script = torch::jit::load(path_);
  const auto frame = torch::zeros({1, 3, 32, 32}, torch::kUInt8);
  const auto refused = [](const std::string& part, const auto& action) {
    try {
      action();
      ADD_FAILURE() << "nothing was thrown: " << part;
    } catch (const std::exception& error) {
      EXPECT_NE(std::string(error.what()).find(part), std::string::npos) << error.what();
    }
  };
  refused("[N, 6, H, W]", [&] { script.forward({torch::zeros({1, 5, 32, 32})}); });
  refused("two frames of equal size", [&] { script.get_method("predict")({frame, frame.slice(2, 0, 16)}); });
}

TEST_F(TorchScriptTest, RefusesWhatItCannotExportAndLeavesNothing) {
  expect_error(ErrorKind::kInvalidArgument, "output channels", [&] {
    FlowNet grey(NetConfig{2, 4, 8, 2, 1});
    export_torchscript(*grey, small_metadata(*grey), path_);
  });
  metadata_.flow_scale = -1;
  expect_error(ErrorKind::kInvalidArgument, "flow_scale", [&] { save(); });
  metadata_.flow_scale = 1;
  {
    const torch::NoGradGuard no_grad;
    net_->parameters()[0].fill_(NAN);
  }
  EXPECT_THROW(save(), Error) << "a network of NaN cannot be verified";
  path_ = folder_.file("missing/model.pt");
  expect_error(ErrorKind::kFileNotFound, "missing", [&] { save(); });
  EXPECT_EQ(folder_.count(), 0U);
}

}  // namespace
}  // namespace ajna::nn
