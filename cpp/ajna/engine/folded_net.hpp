// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <vector>

#include "ajna/nn/flow_net.hpp"

namespace ajna::engine {

/// The network as inference wants it: a copy as a flat list of convolutions with each batch normalization folded into
/// the convolution before it (in float64), channels-last, in one precision on one device.
class FoldedNet {
 public:
  /// `net`'s running statistics are used, as in eval mode; `net` is not changed.
  FoldedNet(const nn::FlowNetImpl& net, torch::Device device, torch::ScalarType precision);

  /// As FlowNet::forward in eval mode: float32 [N, C, H, W] -> float32 [N, out_channels, H, W]; pads and crops.
  [[nodiscard]] torch::Tensor forward(const torch::Tensor& x) const;

 private:
  struct Layer {
    torch::Tensor weight, bias;
    std::int64_t stride = 1, padding = 0, output_padding = 0;
    bool transposed = false;
    bool relu = false;
    bool opens_block = false;   // the input is kept for the sum at the end of the residual block
    bool closes_block = false;  // the kept input is added before the ReLU
  };

  static Layer fold(const torch::nn::Module& owner, const std::string& conv, const std::string& norm);
  [[nodiscard]] torch::Tensor run(torch::Tensor x) const;

  std::vector<Layer> layers_;
  std::int64_t stride_;
  torch::ScalarType precision_;
};

}  // namespace ajna::engine
