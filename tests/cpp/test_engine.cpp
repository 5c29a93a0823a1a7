// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <torch/script.h>

#include <random>
#include <thread>

#include "ajna/engine/flow_engine.hpp"
#include "ajna/nn/folded_net.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/torchscript.hpp"
#include "nn_fixtures.hpp"

namespace ajna::engine {
namespace {

using namespace ajna::testing;

Image noise_image(int width, int height, unsigned seed) {
  Image image(width, height);
  std::mt19937 random(seed);
  for (std::size_t i = 0; i < image.size_bytes(); ++i) {
    image.data()[i] = static_cast<std::uint8_t>(random() & 0xFF);
  }
  return image;
}

torch::Tensor to_tensor(const Image& image) {
  return torch::from_blob(const_cast<std::uint8_t*>(image.data()), {1, image.height(), image.width(), 3}, torch::kUInt8)
      .permute({0, 3, 1, 2})
      .contiguous();
}

torch::Tensor to_tensor(const std::vector<float>& plane, const FlowField& field) {
  return torch::from_blob(const_cast<float*>(plane.data()), {1, field.height, field.width, 2})
      .permute({0, 3, 1, 2})
      .clone();
}

/// Options that differ from the defaults in what `change` sets.
template <typename Change>
EngineOptions options(const Change& change) {
  EngineOptions result;
  change(result);
  return result;
}

class EngineTest : public ::testing::Test {
 protected:
  void SetUp() override {
    net_ = small_net();
    metadata_ = small_metadata(*net_);
    checkpoint_ = folder_.file("model.safetensors");
    nn::save_checkpoint(checkpoint_, *net_, metadata_);
  }
  std::string script() const {
    const std::string path = folder_.file("model.pt");
    nn::export_torchscript(*net_, metadata_, path);
    return path;
  }

  TemporaryFolder folder_;
  nn::FlowNet net_{nullptr};
  nn::Metadata metadata_;
  std::string checkpoint_;
};

TEST_F(EngineTest, FoldedNetworkEqualsTheModule) {
  const torch::NoGradGuard no_grad;
  for (const nn::NetConfig& config : {nn::NetConfig{6, 4, 8, 2, 1}, nn::NetConfig{6, 4, 4, 3, 0}, nn::NetConfig{}}) {
    auto net = small_net(config);
    const nn::FoldedNet folded(*net, torch::kCPU, torch::kFloat32);
    for (const auto& size : {std::pair{32, 48}, std::pair{33, 17}}) {
      const auto x = torch::rand({2, 6, size.first, size.second}) * 2 - 1;
      const auto expected = net->forward(x);
      const auto difference = (folded.forward(x) - expected).abs().max().item<double>();
      EXPECT_LE(difference, 2e-5 * expected.abs().max().item<double>()) << size.first << "x" << size.second;
    }
  }
}

TEST_F(EngineTest, CheckpointAndScriptGiveWhatTheModuleGivesInPixels) {
  const torch::NoGradGuard no_grad;
  for (const auto& path : {checkpoint_, script()}) {
    const auto engine = FlowEngine::load(path);
    for (const auto& [width, height] : std::vector<std::pair<int, int>>{{32, 32}, {61, 37}, {1, 1}, {20, 3}}) {
      const Image image1 = noise_image(width, height, 1), image2 = noise_image(width, height, 2);
      const FlowField field = engine.infer(image1.view(), image2.view(), 12.5);
      EXPECT_EQ(field.width, width);
      EXPECT_EQ(field.height, height);
      EXPECT_EQ(field.timestamp_s, 12.5);
      const auto raw = net_->forward(nn::network_input(to_tensor(image1), to_tensor(image2)));
      const auto values = metadata_.table.evaluate(raw.slice(1, 2, 4));
      const auto close = [&](const std::vector<float>& got, const torch::Tensor& expected) {
        EXPECT_LE((to_tensor(got, field) - expected).abs().max().item<double>(),
                  5e-5 * expected.abs().max().item<double>());
      };
      close(field.flow, raw.slice(1, 0, 2) * metadata_.flow_scale);
      close(field.uncertainty, values.uncertainty);
      close(field.expected_error, values.expected_error * metadata_.flow_scale);
    }
  }
}

TEST_F(EngineTest, BatchEqualsOneByOne) {
  const auto engine = FlowEngine::load(checkpoint_);
  std::vector<Image> images;
  for (unsigned i = 0; i < 4; ++i) {
    images.push_back(noise_image(40, 24, i));
  }
  std::vector<FramePair> pairs;
  for (std::size_t i = 0; i + 1 < images.size(); ++i) {
    pairs.push_back({images[i].view(), images[i + 1].view(), static_cast<double>(i)});
  }
  const auto fields = engine.infer_batch(pairs);
  ASSERT_EQ(fields.size(), 3U);
  for (std::size_t i = 0; i < fields.size(); ++i) {
    const auto single = engine.infer(pairs[i].frame1, pairs[i].frame2);
    EXPECT_EQ(fields[i].timestamp_s, static_cast<double>(i));
    for (std::size_t k = 0; k < single.flow.size(); ++k) {
      ASSERT_NEAR(fields[i].flow[k], single.flow[k], 1e-4);
      ASSERT_NEAR(fields[i].uncertainty[k], single.uncertainty[k], 1e-4);
    }
  }
  EXPECT_TRUE(engine.infer_batch({}).empty());
}

TEST_F(EngineTest, ReadsPaddedRowsAndReusesMemory) {
  const auto engine = FlowEngine::load(checkpoint_);
  const Image wide = noise_image(50, 20, 3), other = noise_image(30, 20, 4);
  // The left 30 columns of a wider image, and the same pixels in an image of their own.
  ImageView view = wide.view();
  view.width = 30;
  Image cropped(30, 20);
  for (int y = 0; y < 20; ++y) {
    std::copy_n(wide.data() + y * 150, 90, cropped.data() + y * 90);
  }
  const auto expected = engine.infer(cropped.view(), other.view());
  FlowField field;
  engine.infer_into(view, other.view(), field);
  EXPECT_EQ(field.flow, expected.flow);
  const float* memory = field.flow.data();
  engine.infer_into(other.view(), view, field, 1.0);
  EXPECT_EQ(field.flow.data(), memory);
}

TEST_F(EngineTest, Bfloat16IsNearFloat32) {
  const auto exact = FlowEngine::load(checkpoint_);
  const auto fast = FlowEngine::load(checkpoint_, options([](auto& o) { o.bfloat16 = true; }));
  EXPECT_EQ(fast.info().precision, "bfloat16");
  const Image image1 = noise_image(48, 32, 1), image2 = noise_image(48, 32, 2);
  const auto a = exact.infer(image1.view(), image2.view()), b = fast.infer(image1.view(), image2.view());
  double scale = 0, difference = 0;
  for (std::size_t i = 0; i < a.flow.size(); ++i) {
    scale = std::max<double>(scale, std::abs(a.flow[i]));
    difference = std::max<double>(difference, std::abs(a.flow[i] - b.flow[i]));
  }
  EXPECT_LT(difference, 0.1 * scale);
  EXPECT_GT(difference, 0.0) << "bfloat16 was not used";
}

TEST_F(EngineTest, InfoSaysWhatWasLoaded) {
  for (const auto& path : {checkpoint_, script()}) {
    const auto engine = FlowEngine::load(path);
    const ModelInfo& info = engine.info();
    EXPECT_EQ(info.name, "ajna-test");
    EXPECT_EQ(info.path, path);
    EXPECT_EQ(info.format, path == checkpoint_ ? "checkpoint" : "torchscript");
    EXPECT_EQ(info.device, "cpu");
    EXPECT_EQ(info.precision, "float32");
    EXPECT_EQ(info.parameters, nn::count_parameters(metadata_.net));
    EXPECT_EQ(info.flow_scale, 2.5);
    EXPECT_EQ(info.network.at("width"), 8);
    EXPECT_EQ(info.provenance, metadata_.provenance);
    EXPECT_FALSE(info.calibrated);
    EXPECT_TRUE(info.interval_levels.empty());
  }
}

TEST_F(EngineTest, CalibrationReachesTheFields) {
  EXPECT_FALSE(FlowEngine::load(checkpoint_).info().calibrated);
  metadata_.calibration = nn::Calibration{
      {{0.5, 0.9}, {{1, 2}, {3, 4}}}, {{"data", "scenes"}, {"images", "9"}, {"pixels", "77"}, {"date", "2026-01-02"}}};
  nn::save_checkpoint(checkpoint_, *net_, metadata_);
  const Image image1 = noise_image(20, 12, 1), image2 = noise_image(20, 12, 2);
  for (const auto& path : {checkpoint_, script()}) {
    const auto engine = FlowEngine::load(path);
    EXPECT_TRUE(engine.info().calibrated);
    EXPECT_EQ(engine.info().interval_levels, (std::vector<double>{0.5, 0.9}));
    EXPECT_EQ(engine.info().calibration.at("images"), "9");
    const auto field = engine.infer(image1.view(), image2.view());
    const auto interval = field.interval(0.9);
    ASSERT_EQ(interval.low.size(), field.flow.size());
    for (std::size_t i = 0; i < field.flow.size(); ++i) {
      const double reach = (i % 2 == 0 ? 3.0 : 4.0) * field.expected_error[i];
      EXPECT_NEAR(interval.high[i] - field.flow[i], reach, 1e-4 * (1 + reach));
      EXPECT_NEAR(field.flow[i] - interval.low[i], reach, 1e-4 * (1 + reach));
    }
    expect_error(ErrorKind::kInvalidArgument, "from 0.5 to 0.9", [&] { (void)field.interval(0.95); });
  }
}

TEST_F(EngineTest, RefusesUnusableFrames) {
  const auto engine = FlowEngine::load(checkpoint_, options([](auto& o) { o.max_pixels = 1000; }));
  const Image image(20, 10);
  const auto refused = [&](const std::string& part, const ImageView& a, const ImageView& b) {
    expect_error(ErrorKind::kInvalidArgument, part, [&] { engine.infer(a, b); });
  };
  const ImageView view = image.view();
  const ImageView huge{view.data, 2000000000, 2000000000, 3, std::ptrdiff_t{6000000000}};
  refused("frame 1 is empty", ImageView{}, view);
  refused("frame 2 is empty (0x10)", view, {view.data, 0, 10, 3, 60});
  refused("frame 1 has 1 channels", {view.data, 20, 10, 1, 20}, view);
  refused("frame 2 has 4 channels", view, {view.data, 20, 10, 4, 80});
  refused("rows 59 bytes apart", {view.data, 20, 10, 3, 59}, view);
  refused("frame 2 is 10x20 but frame 1 is 20x10", view, {view.data, 10, 20, 3, 30});
  refused("exceed 1000 pixels", huge, huge);
  expect_error(ErrorKind::kInvalidArgument, "frame 1 of pair 1 is 5x5", [&] {
    const Image other(5, 5);
    engine.infer_batch({{view, view}, {other.view(), other.view()}});
  });
  expect_error(ErrorKind::kInvalidArgument, "batch of 6", [&] {
    engine.infer_batch(std::vector<FramePair>(6, FramePair{view, view}));
  });
  EXPECT_NO_THROW(engine.infer(view, view));
}

TEST_F(EngineTest, NanFromTheNetworkIsAnError) {
  // Finite weights whose products overflow.
  {
    const torch::NoGradGuard no_grad;
    for (auto& parameter : net_->parameters()) {
      parameter.fill_(1e30);
    }
  }
  nn::save_checkpoint(checkpoint_, *net_, metadata_);
  const auto engine = FlowEngine::load(checkpoint_);
  const Image image = noise_image(32, 32, 5);
  expect_error(ErrorKind::kRuntime, "NaN or infinite", [&] { engine.infer(image.view(), image.view()); });
}

TEST_F(EngineTest, RefusesUnusableOptions) {
  const auto refused = [&](const std::string& part, const EngineOptions& options) {
    expect_error(ErrorKind::kInvalidArgument, part, [&] { FlowEngine::load(checkpoint_, options); });
  };
  refused("device 'gpu'", options([](auto& o) { o.device = "gpu"; }));
  refused("device 'cuda:x'", options([](auto& o) { o.device = "cuda:x"; }));
  refused("device 'cuda:-1'", options([](auto& o) { o.device = "cuda:-1"; }));
  refused("threads = -1", options([](auto& o) { o.threads = -1; }));
  refused("max_pixels = 0", options([](auto& o) { o.max_pixels = 0; }));
  if (!torch::cuda::is_available()) {
    expect_error(ErrorKind::kRuntime, "sees 0 CUDA devices",
                 [&] { FlowEngine::load(checkpoint_, options([](auto& o) { o.device = "cuda"; })); });
  }
  expect_error(ErrorKind::kInvalidArgument, "bfloat16 needs a checkpoint",
               [&] { FlowEngine::load(folder_.file("a.pt"), options([](auto& o) { o.bfloat16 = true; })); });
}

TEST_F(EngineTest, RefusesForeignFiles) {
  expect_error(ErrorKind::kFileNotFound, "none.safetensors",
               [&] { FlowEngine::load(folder_.file("none.safetensors")); });
  expect_error(ErrorKind::kFileNotFound, "none.pt", [&] { FlowEngine::load(folder_.file("none.pt")); });
  expect_error(ErrorKind::kInvalidArgument, "give a checkpoint", [&] { FlowEngine::load(folder_.file("model.onnx")); });
  const std::string path = folder_.file("foreign.pt");
  write_bytes(path, "not a model");
  expect_error(ErrorKind::kInvalidArgument, "not a usable TorchScript file", [&] { FlowEngine::load(path); });
  const std::string whole = read_bytes(script());
  write_bytes(path, whole.substr(0, whole.size() / 2));
  expect_error(ErrorKind::kInvalidArgument, "not a usable TorchScript file", [&] { FlowEngine::load(path); });

  torch::jit::Module foreign("Foreign");
  foreign.define("def forward(self, x: Tensor) -> Tensor:\n    return x\n");
  foreign.save(path);
  expect_error(ErrorKind::kInvalidArgument, "not one of Ajna's", [&] { FlowEngine::load(path); });
  foreign.define("def predict(self, a: Tensor, b: Tensor) -> Tensor:\n    return a\n");
  foreign.save(path, {{"ajna.json", "{}"}});
  expect_error(ErrorKind::kInvalidArgument, "no Ajna metadata", [&] { FlowEngine::load(path); });

  auto grey = small_net({2, 4, 8, 2, 1});
  nn::save_checkpoint(checkpoint_, *grey, small_metadata(*grey));
  expect_error(ErrorKind::kInvalidArgument, "from 2 to 4", [&] { FlowEngine::load(checkpoint_); });
}

TEST_F(EngineTest, AScriptThatBreaksItsContractIsAnError) {
  torch::jit::Module liar("Liar");
  liar.define(
      "def forward(self, x: Tensor) -> Tensor:\n    return x\n"
      "def predict(self, a: Tensor, b: Tensor) -> Tuple[Tensor, Tensor]:\n    return a, b\n");
  const std::string path = folder_.file("liar.pt");
  std::string json = "{";
  for (const auto& [key, value] : nn::metadata_to_strings(small_metadata(*net_))) {
    if (key.rfind("provenance", 0) != 0) {
      json += (json.size() > 1 ? ",\"" : "\"") + key + "\":\"" + value + "\"";
    }
  }
  liar.save(path, {{"ajna.json", json + "}"}});
  const auto engine = FlowEngine::load(path);
  const Image image(32, 32);
  expect_error(ErrorKind::kRuntime, "'predict' does not give", [&] { engine.infer(image.view(), image.view()); });
}

TEST_F(EngineTest, RunsFromSeveralThreads) {
  const auto engine = FlowEngine::load(checkpoint_);
  engine.warm_up(40, 24);
  const Image image1 = noise_image(40, 24, 1), image2 = noise_image(40, 24, 2);
  const auto expected = engine.infer(image1.view(), image2.view());
  std::vector<FlowField> fields(4);
  std::vector<std::thread> threads;
  for (auto& field : fields) {
    threads.emplace_back([&] { field = engine.infer(image1.view(), image2.view()); });
  }
  for (auto& thread : threads) {
    thread.join();
  }
  for (const auto& field : fields) {
    ASSERT_EQ(field.flow.size(), expected.flow.size());
    for (std::size_t i = 0; i < field.flow.size(); ++i) {
      ASSERT_NEAR(field.flow[i], expected.flow[i], 1e-4);
    }
  }
  expect_error(ErrorKind::kInvalidArgument, "batch 0", [&] { engine.warm_up(40, 24, 0); });
}

}  // namespace
}  // namespace ajna::engine
