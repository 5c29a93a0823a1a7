// SPDX-License-Identifier: MIT
#include "ajna/engine/folded_net.hpp"

#include <string>

namespace ajna::engine {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

/// Shape [1, C, 1, 1] or [C, 1, 1, 1]: one factor per output channel of a kernel.
Tensor per_output_channel(const Tensor& factor, bool transposed) {
  return transposed ? factor.view({1, -1, 1, 1}) : factor.view({-1, 1, 1, 1});
}

}  // namespace

FoldedNet::Layer FoldedNet::fold(const torch::nn::Module& owner, const std::string& conv, const std::string& norm) {
  const auto children = owner.named_children();
  Layer layer;
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

FoldedNet::FoldedNet(const nn::FlowNetImpl& net, torch::Device device, torch::ScalarType precision)
    : stride_(net.config().stride()), precision_(precision) {
  const torch::NoGradGuard no_grad;
  for (const auto& part : net.children()) {  // encoder, decoder
    for (const auto& block : part->children()) {
      if (block->as<nn::ConvUnitImpl>() != nullptr) {
        layers_.push_back(fold(*block, "conv", "norm"));
        continue;
      }
      layers_.push_back(fold(*block, "conv1", "norm1"));
      layers_.back().opens_block = true;
      layers_.push_back(fold(*block, "conv2", "norm2"));
      layers_.back().closes_block = true;
    }
  }
  for (auto& layer : layers_) {
    layer.weight = layer.weight.to(device, precision).contiguous(torch::MemoryFormat::ChannelsLast);
    layer.bias = layer.bias.to(device, precision).contiguous();
  }
}

Tensor FoldedNet::run(Tensor x) const {
  Tensor kept;
  for (const auto& layer : layers_) {
    if (layer.opens_block) {
      kept = x;
    }
    x = layer.transposed
            ? torch::conv_transpose2d(x, layer.weight, layer.bias, layer.stride, layer.padding, layer.output_padding)
            : torch::conv2d(x, layer.weight, layer.bias, layer.stride, layer.padding);
    if (layer.closes_block) {
      x.add_(kept);
    }
    if (layer.relu) {
      x.relu_();
    }
  }
  return x;
}

Tensor FoldedNet::forward(const Tensor& x) const {
  const std::int64_t height = x.size(2), width = x.size(3);
  const std::int64_t pad_y = (stride_ - height % stride_) % stride_, pad_x = (stride_ - width % stride_) % stride_;
  auto input = x;
  if (pad_y > 0 || pad_x > 0) {
    input = F::pad(input, F::PadFuncOptions({0, pad_x, 0, pad_y}).mode(torch::kReplicate));
  }
  input = input.to(precision_).contiguous(torch::MemoryFormat::ChannelsLast);
  return run(std::move(input)).slice(2, 0, height).slice(3, 0, width).to(torch::kFloat32);
}

}  // namespace ajna::engine
