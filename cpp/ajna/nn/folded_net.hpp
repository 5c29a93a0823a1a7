// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <array>
#include <string>
#include <vector>

#include "ajna/nn/flow_graph.hpp"
#include "ajna/nn/flow_net.hpp"

namespace ajna::nn {

/// The network as inference wants it: a copy as convolutions with each batch normalization folded into the convolution
/// before it (in float64), channels-last, in one precision on one device; wired by run_graph, as the network is.
class FoldedNet {
 public:
  /// `net`'s running statistics are used, as in eval mode; `net` is not changed.
  FoldedNet(const FlowNetImpl& net, torch::Device device, torch::ScalarType precision);

  /// As FlowNet::forward in eval mode: float32 [N, C, H, W] -> float32 [N, out_channels, H, W]; pads and crops.
  [[nodiscard]] torch::Tensor forward(const torch::Tensor& x) const;
  /// The same for sizes that are multiples of the stride: neither pads nor crops, and can be traced.
  [[nodiscard]] torch::Tensor forward_aligned(const torch::Tensor& x) const;
  /// Weights and biases, those that `forward` uses and not copies of them.
  [[nodiscard]] std::vector<torch::Tensor> tensors() const;

 private:
  struct Convolution {
    torch::Tensor weight, bias;
    std::int64_t stride = 1, padding = 0, output_padding = 0;
    bool transposed = false;
    bool relu = false;
    [[nodiscard]] torch::Tensor run(const torch::Tensor& x) const;
  };
  /// A convolution unit, or a residual block where there are two.
  using Block = std::vector<Convolution>;

  static Convolution fold(const torch::nn::Module& owner, const std::string& conv, const std::string& norm);
  static torch::Tensor run(const Block& block, const torch::Tensor& x);

  std::array<std::vector<Block>, kPartCount> parts_;  // by Part
  NetConfig config_;
  torch::ScalarType precision_;
};

}  // namespace ajna::nn
