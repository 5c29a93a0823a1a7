// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <utility>
#include <vector>

#include "ajna/nn/net_config.hpp"

namespace ajna::nn {

/// conv 3x3 - BN - ReLU - conv 3x3 - BN, plus identity, ReLU; both convolutions transposed in the decoder.
/// [N, C, H, W] -> [N, C, H, W].
class ResidualBlockImpl : public torch::nn::Module {
 public:
  ResidualBlockImpl(std::int64_t channels, bool transposed);
  torch::Tensor forward(const torch::Tensor& x);

 private:
  bool transposed_;
  torch::nn::Conv2d conv1_{nullptr}, conv2_{nullptr};
  torch::nn::ConvTranspose2d deconv1_{nullptr}, deconv2_{nullptr};
  torch::nn::BatchNorm2d norm1_{nullptr}, norm2_{nullptr};
};
TORCH_MODULE(ResidualBlock);

/// A convolution, or a transposed one, with bias; then BN and ReLU where `activated`.
/// Down-sampling halves the sides, up-sampling doubles them, stride 1 keeps them.
class ConvUnitImpl : public torch::nn::Module {
 public:
  struct Options {
    std::int64_t in_channels, out_channels, kernel, stride;
    bool transposed;
    bool activated;
  };
  explicit ConvUnitImpl(const Options& options);
  torch::Tensor forward(const torch::Tensor& x);

 private:
  torch::nn::Conv2d conv_{nullptr};
  torch::nn::ConvTranspose2d deconv_{nullptr};
  torch::nn::BatchNorm2d norm_{nullptr};
};
TORCH_MODULE(ConvUnit);

/// The paper's residual encoder-decoder (EVPropNet with four output channels), and its variants by NetConfig.
///
/// Input [N, in_channels, H, W] float in [-1, 1] (frame 1 RGB, frame 2 RGB), any H and W >= 1.
/// Output [N, out_channels, H, W]: u, v in training units (pixels / flow_scale), then the raw uncertainty of u and v.
class FlowNetImpl : public torch::nn::Module {
 public:
  /// Throws Error(kInvalidArgument) where a field of `config` is out of range.
  explicit FlowNetImpl(const NetConfig& config = {});

  /// Pad by replication to a multiple of config().stride(), run, crop. Throws Error(kInvalidArgument) for a tensor that
  /// is not [N, in_channels, H, W] floating point.
  torch::Tensor forward(const torch::Tensor& x);
  /// The bare network; both sides must be multiples of config().stride(). This is what is traced for TorchScript.
  torch::Tensor forward_aligned(const torch::Tensor& x);

  /// The predictions from coarse to fine, the last at full size, for a loss on each: three with config().scale_heads
  /// (at 1/4, 1/2 and the whole size, all in the unit of the last), else one. Sides as for forward_aligned.
  std::vector<torch::Tensor> forward_scales(const torch::Tensor& x);

  /// Output and inner activations, for training with auxiliary losses: what each layer gives, from the first
  /// convolution to the last, so that back() is the output. Both sides must be multiples of config().stride().
  std::vector<torch::Tensor> forward_layers(const torch::Tensor& x);
  /// forward_scales and forward_layers of one pass.
  std::pair<std::vector<torch::Tensor>, std::vector<torch::Tensor>> forward_scales_and_layers(const torch::Tensor& x);

  [[nodiscard]] const NetConfig& config() const noexcept { return config_; }

 private:
  std::vector<torch::Tensor> run(const torch::Tensor& x, std::vector<torch::Tensor>* activations);

  NetConfig config_;
  std::vector<torch::nn::ModuleList> parts_;  // by Part; only those with layers are registered
};
TORCH_MODULE(FlowNet);

/// Number of learnable parameters.
std::int64_t count_parameters(const torch::nn::Module& module);
/// The same for the network that `config` describes, without allocating it (its size may come from an untrusted file).
std::int64_t count_parameters(const NetConfig& config);

/// Multiply-accumulates of one forward pass over one [height, width] pair, counted from the convolutions of `config`
/// (the paper counts 2 FLOP each: 6.33 GFLOP at 320x240).
std::int64_t count_macs(const NetConfig& config, std::int64_t height, std::int64_t width);

}  // namespace ajna::nn
