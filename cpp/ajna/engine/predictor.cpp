// SPDX-License-Identifier: MIT
#include "ajna/engine/predictor.hpp"

#include <torch/script.h>

#include <filesystem>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/nn/folded_net.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/safetensors_header.hpp"
#include "ajna/nn/torchscript.hpp"

namespace ajna::engine {
namespace {

constexpr const char* kFloat32 = "float32";
constexpr const char* kBfloat16 = "bfloat16";

class CheckpointPredictor : public Predictor {
 public:
  CheckpointPredictor(const nn::FlowNetImpl& net, const nn::Metadata& metadata, torch::Device device,
                      torch::ScalarType precision)
      : net_(net, device, precision), table_(metadata.table.to(device)), flow_scale_(metadata.flow_scale) {}

  [[nodiscard]] Output predict(const torch::Tensor& frame1, const torch::Tensor& frame2) const override {
    const auto output = net_.forward(nn::network_input(frame1, frame2));
    auto values = table_.evaluate(output.slice(1, 2, 4));
    return {output.slice(1, 0, 2) * flow_scale_, std::move(values.uncertainty), values.expected_error * flow_scale_};
  }

 private:
  nn::FoldedNet net_;
  nn::UncertaintyTable table_;
  double flow_scale_;
};

class ScriptPredictor : public Predictor {
 public:
  explicit ScriptPredictor(torch::jit::Module script) : script_(std::move(script)) {}

  [[nodiscard]] Output predict(const torch::Tensor& frame1, const torch::Tensor& frame2) const override {
    const auto result = script_.get_method("predict")({frame1, frame2});
    // The file is a program; hold it to its contract.
    if (result.isTuple() && result.toTupleRef().elements().size() == 3) {
      const auto& parts = result.toTupleRef().elements();
      bool fits = true;
      for (const auto& part : parts) {
        fits = fits && part.isTensor() && part.toTensor().scalar_type() == torch::kFloat32 &&
               part.toTensor().sizes() == torch::IntArrayRef({frame1.size(0), 2, frame1.size(2), frame1.size(3)});
      }
      if (fits) {
        return {parts[0].toTensor(), parts[1].toTensor(), parts[2].toTensor()};
      }
    }
    throw_runtime("the TorchScript method 'predict' does not give three float32 tensors [N, 2, H, W]: export it again");
  }

 private:
  torch::jit::Module script_;
};

}  // namespace

LoadedModel load_checkpoint_model(const std::string& path, torch::Device device, bool bfloat16) {
  nn::Checkpoint checkpoint = nn::load_checkpoint(path);
  const auto& net = checkpoint.metadata.net;
  if (net.in_channels != 6 || net.out_channels != 4) {
    throw_invalid("'" + path + "' holds a network from " + std::to_string(net.in_channels) + " to " +
                  std::to_string(net.out_channels) +
                  " channels: the engine runs networks from two RGB frames (6) to flow and uncertainty (4)");
  }
  auto predictor = std::make_unique<CheckpointPredictor>(*checkpoint.net, checkpoint.metadata, device,
                                                         bfloat16 ? torch::kBFloat16 : torch::kFloat32);
  return {std::move(predictor), std::move(checkpoint.metadata), bfloat16 ? kBfloat16 : kFloat32};
}

LoadedModel load_torchscript_model(const std::string& path, torch::Device device) {
  const std::string remedy = ": give a file written by `ajna export --format torchscript`";
  if (!std::filesystem::exists(path)) {
    throw_not_found(path, "give the path of a TorchScript file");
  }
  if (!std::filesystem::is_regular_file(path)) {
    throw_invalid("'" + path + "' is not a regular file" + remedy);
  }
  torch::jit::Module script;
  torch::jit::ExtraFilesMap files{{nn::kScriptMetadataFile, ""}, {nn::kScriptPrecisionFile, kFloat32}};
  try {
    script = torch::jit::load(path, device, files);
  } catch (const std::exception&) {
    // LibTorch's own text is a page long and about its internals.
    throw_invalid("'" + path + "' is not a usable TorchScript file (foreign, truncated, or of a newer torch)" + remedy);
  }
  if (files[nn::kScriptMetadataFile].empty() || !script.find_method("predict")) {
    throw_invalid("'" + path + "' is a TorchScript file but not one of Ajna's" + remedy);
  }
  LoadedModel model;
  model.precision = files[nn::kScriptPrecisionFile];
  if (model.precision != kFloat32 && model.precision != kBfloat16) {
    throw_invalid("'" + path + "' is said to run in '" + model.precision + "', which this version does not know" +
                  remedy);
  }
  try {
    model.metadata = nn::metadata_from_strings(nn::parse_string_map(files[nn::kScriptMetadataFile]));
  } catch (const Error& error) {
    throw_invalid("'" + path + "' is not a usable Ajna model: " + error.what());
  }
  model.predictor = std::make_unique<ScriptPredictor>(std::move(script));
  return model;
}

}  // namespace ajna::engine
