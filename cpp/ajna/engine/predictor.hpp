// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <memory>
#include <string>

#include "ajna/engine/flow_engine.hpp"
#include "ajna/nn/checkpoint.hpp"

namespace ajna::engine {

/// What differs between the two file formats: how uint8 frames become tensors of pixels.
class Predictor {
 public:
  struct Output {
    torch::Tensor flow, uncertainty, expected_error;  ///< [N, 2, H, W] float32 on the predictor's device
  };
  virtual ~Predictor() = default;
  /// Frames [N, 3, H, W] uint8 on the predictor's device; runs under c10::InferenceMode.
  [[nodiscard]] virtual Output predict(const torch::Tensor& frame1, const torch::Tensor& frame2) const = 0;
};

/// A predictor with what its file says about itself.
struct LoadedModel {
  std::unique_ptr<Predictor> predictor;
  nn::Metadata metadata;
  std::string precision;  ///< in which the network runs: "float32" or "bfloat16"
};

/// Both throw Error as FlowEngine::load does.
LoadedModel load_checkpoint_model(const std::string& path, torch::Device device, bool bfloat16);
LoadedModel load_torchscript_model(const std::string& path, torch::Device device);

}  // namespace ajna::engine
