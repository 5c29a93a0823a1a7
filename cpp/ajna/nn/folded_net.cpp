// SPDX-License-Identifier: MIT
#include "ajna/nn/folded_net.hpp"

#include <string>

namespace ajna::nn {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

/// Shape [1, C, 1, 1] or [C, 1, 1, 1]: one factor per output channel of a kernel.
Tensor per_output_channel(const Tensor& factor, bool transposed) {
  return transposed ? factor.view({1, -1, 1, 1}) : factor.view({-1, 1, 1, 1});
}

}  // namespace

FoldedNet::Convolution FoldedNet::fold(const torch::nn::Module& owner, const std::string& conv,
                                       const std::string& norm) {
  const auto children = owner.named_children();
  Convolution layer;
  if (const auto* plain = children[conv]->as<torch::nn::Conv2dImpl>()) {
    layer.weight = plain->weight;
    layer.bias = plain->bias;
    layer.stride = (*plain->options.stride())[0];
    layer.padding = plain->weight.size(2) / 2;
  } else {
    const auto* transposed = children[conv]->as<torch::nn::ConvTranspose2dImpl>();
    layer.transposed = true;
    layer.weight = transposed->weight;
    layer.bias = transposed->bias;
    layer.stride = (*transposed->options.stride())[0];
    layer.padding = transposed->weight.size(2) / 2;
    layer.output_padding = layer.stride - 1;
  }
  const auto* found = children.find(norm);
  if (found != nullptr) {
    const auto& bn = *(*found)->as<torch::nn::BatchNorm2dImpl>();
    const auto factor = bn.weight.to(torch::kFloat64) / (bn.running_var.to(torch::kFloat64) + bn.options.eps()).sqrt();
    layer.weight = layer.weight.to(torch::kFloat64) * per_output_channel(factor, layer.transposed);
    layer.bias = (layer.bias.to(torch::kFloat64) - bn.running_mean) * factor + bn.bias;
    layer.relu = true;
  }
  return layer;
}

FoldedNet::FoldedNet(const FlowNetImpl& net, torch::Device device, torch::ScalarType precision)
    : config_(net.config()), precision_(precision) {
  const torch::NoGradGuard no_grad;
  const auto children = net.named_children();
  for (std::size_t part = 0; part < parts_.size(); ++part) {
    const auto* list = children.find(part_name(static_cast<Part>(part)));
    if (list == nullptr) {
      continue;
    }
    for (const auto& layer : (*list)->children()) {
      if (layer->as<ConvUnitImpl>() != nullptr) {
        parts_[part].push_back({fold(*layer, "conv", "norm")});
      } else {
        parts_[part].push_back({fold(*layer, "conv1", "norm1"), fold(*layer, "conv2", "norm2")});
      }
      for (auto& convolution : parts_[part].back()) {
        convolution.weight = convolution.weight.to(device, precision).contiguous(torch::MemoryFormat::ChannelsLast);
        convolution.bias = convolution.bias.to(device, precision).contiguous();
      }
    }
  }
}

Tensor FoldedNet::Convolution::run(const Tensor& x) const {
  return transposed ? torch::conv_transpose2d(x, weight, bias, stride, padding, output_padding)
                    : torch::conv2d(x, weight, bias, stride, padding);
}

Tensor FoldedNet::run(const Block& block, const Tensor& x) {
  auto y = x;
  for (std::size_t i = 0; i < block.size(); ++i) {
    y = block[i].run(y);
    if (i == 1) {  // the end of a residual block
      y.add_(x);
    }
    if (block[i].relu) {
      y.relu_();
    }
  }
  return y;
}

Tensor FoldedNet::forward(const Tensor& x) const {
  const std::int64_t height = x.size(2), width = x.size(3), stride = config_.stride();
  const std::int64_t pad_y = (stride - height % stride) % stride, pad_x = (stride - width % stride) % stride;
  auto input = x;
  if (pad_y > 0 || pad_x > 0) {
    input = F::pad(input, F::PadFuncOptions({0, pad_x, 0, pad_y}).mode(torch::kReplicate));
  }
  return forward_aligned(input).slice(2, 0, height).slice(3, 0, width);
}

Tensor FoldedNet::forward_aligned(const Tensor& x) const {
  const auto layer = [this](Part part, std::size_t index, const Tensor& y) {
    return run(parts_[static_cast<std::size_t>(part)][index], y);
  };
  const auto input = x.to(precision_).contiguous(torch::MemoryFormat::ChannelsLast);
  return run_graph(config_, input, layer).back().to(torch::kFloat32);
}

std::vector<Tensor> FoldedNet::tensors() const {
  std::vector<Tensor> result;
  for (const auto& part : parts_) {
    for (const auto& block : part) {
      for (const auto& convolution : block) {
        result.insert(result.end(), {convolution.weight, convolution.bias});
      }
    }
  }
  return result;
}

}  // namespace ajna::nn
