// SPDX-License-Identifier: MIT
#include "ajna/nn/flow_net.hpp"

#include <array>
#include <string>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/nn/flow_graph.hpp"

namespace ajna::nn {
namespace {

namespace F = torch::nn::functional;

/// In the order of their values.
constexpr std::array<Part, kPartCount> kParts{Part::kEncoder, Part::kDecoder, Part::kHeads, Part::kMatching,
                                              Part::kSkips};

void append_layers(torch::nn::ModuleList& list, const std::vector<Layer>& layers) {
  for (const auto& layer : layers) {
    if (layer.is_residual()) {
      list->push_back(ResidualBlock(layer.in_channels, layer.transposed));
    } else {
      list->push_back(ConvUnit(ConvUnitImpl::Options{layer.in_channels, layer.out_channels, layer.kernel, layer.stride,
                                                     layer.transposed, layer.activated}));
    }
  }
}

torch::Tensor run_layer(torch::nn::Module& layer, const torch::Tensor& x) {
  if (auto* unit = layer.as<ConvUnitImpl>()) {
    return unit->forward(x);
  }
  return layer.as<ResidualBlockImpl>()->forward(x);
}

}  // namespace

ResidualBlockImpl::ResidualBlockImpl(std::int64_t channels, bool transposed) : transposed_(transposed) {
  if (transposed) {
    const auto options = torch::nn::ConvTranspose2dOptions(channels, channels, 3).padding(1);
    deconv1_ = register_module("conv1", torch::nn::ConvTranspose2d(options));
    norm1_ = register_module("norm1", torch::nn::BatchNorm2d(channels));
    deconv2_ = register_module("conv2", torch::nn::ConvTranspose2d(options));
  } else {
    const auto options = torch::nn::Conv2dOptions(channels, channels, 3).padding(1);
    conv1_ = register_module("conv1", torch::nn::Conv2d(options));
    norm1_ = register_module("norm1", torch::nn::BatchNorm2d(channels));
    conv2_ = register_module("conv2", torch::nn::Conv2d(options));
  }
  norm2_ = register_module("norm2", torch::nn::BatchNorm2d(channels));
}

torch::Tensor ResidualBlockImpl::forward(const torch::Tensor& x) {
  auto y = transposed_ ? deconv1_->forward(x) : conv1_->forward(x);
  y = torch::relu(norm1_->forward(y));
  y = transposed_ ? deconv2_->forward(y) : conv2_->forward(y);
  return torch::relu(norm2_->forward(y) + x);
}

ConvUnitImpl::ConvUnitImpl(const Options& o) {
  if (o.transposed) {
    deconv_ = register_module(
        "conv", torch::nn::ConvTranspose2d(torch::nn::ConvTranspose2dOptions(o.in_channels, o.out_channels, o.kernel)
                                               .stride(o.stride)
                                               .padding(o.kernel / 2)
                                               .output_padding(o.stride - 1)));
  } else {
    conv_ = register_module(
        "conv",
        torch::nn::Conv2d(
            torch::nn::Conv2dOptions(o.in_channels, o.out_channels, o.kernel).stride(o.stride).padding(o.kernel / 2)));
  }
  if (o.activated) {
    norm_ = register_module("norm", torch::nn::BatchNorm2d(o.out_channels));
  }
}

torch::Tensor ConvUnitImpl::forward(const torch::Tensor& x) {
  auto y = deconv_ ? deconv_->forward(x) : conv_->forward(x);
  return norm_ ? torch::relu(norm_->forward(y)) : y;
}

FlowNetImpl::FlowNetImpl(const NetConfig& config) : config_(config) {
  const LayerTable table = layer_table(config);
  for (const auto part : kParts) {
    const auto& layers = table.part(part);
    auto& list = parts_.emplace_back(torch::nn::ModuleList());
    if (!layers.empty()) {
      register_module(part_name(part), list);
      append_layers(list, layers);
    }
  }
}

torch::Tensor FlowNetImpl::forward(const torch::Tensor& x) {
  if (x.dim() != 4 || x.size(1) != config_.in_channels || !x.is_floating_point() || x.size(2) < 1 || x.size(3) < 1) {
    throw_invalid("network input " + std::string(c10::str(x.sizes())) + " " + std::string(x.dtype().name()) +
                  ": give a floating-point tensor [N, " + std::to_string(config_.in_channels) + ", H, W]");
  }
  const std::int64_t stride = config_.stride(), height = x.size(2), width = x.size(3);
  const std::int64_t pad_y = (stride - height % stride) % stride, pad_x = (stride - width % stride) % stride;
  if (pad_y == 0 && pad_x == 0) {
    return forward_aligned(x);
  }
  const auto padded = F::pad(x, F::PadFuncOptions({0, pad_x, 0, pad_y}).mode(torch::kReplicate));
  return forward_aligned(padded).slice(2, 0, height).slice(3, 0, width);
}

std::vector<torch::Tensor> FlowNetImpl::run(const torch::Tensor& x, std::vector<torch::Tensor>* activations) {
  const auto layer = [this](Part part, std::size_t index, const torch::Tensor& input) {
    return run_layer(*parts_[static_cast<std::size_t>(part)]->ptr(index), input);
  };
  return run_graph(config_, x, layer, activations);
}

torch::Tensor FlowNetImpl::forward_aligned(const torch::Tensor& x) { return run(x, nullptr).back(); }

std::vector<torch::Tensor> FlowNetImpl::forward_scales(const torch::Tensor& x) { return run(x, nullptr); }

std::vector<torch::Tensor> FlowNetImpl::forward_layers(const torch::Tensor& x) {
  return forward_scales_and_layers(x).second;
}

std::pair<std::vector<torch::Tensor>, std::vector<torch::Tensor>> FlowNetImpl::forward_scales_and_layers(
    const torch::Tensor& x) {
  std::vector<torch::Tensor> layers;
  auto scales = run(x, &layers);
  return {std::move(scales), std::move(layers)};
}

std::int64_t count_parameters(const torch::nn::Module& module) {
  std::int64_t count = 0;
  for (const auto& parameter : module.parameters()) {
    count += parameter.numel();
  }
  return count;
}

std::int64_t count_parameters(const NetConfig& config) {
  const LayerTable table = layer_table(config);
  std::int64_t count = 0;
  for (const auto part : kParts) {
    for (const auto& layer : table.part(part)) {
      const std::int64_t c = layer.out_channels;
      count += layer.is_residual()
                   ? 2 * (9 * c * c + 3 * c)
                   : layer.kernel * layer.kernel * layer.in_channels * c + (layer.activated ? 3 * c : c);
    }
  }
  return count;
}

std::int64_t count_macs(const NetConfig& config, std::int64_t height, std::int64_t width) {
  const LayerTable table = layer_table(config);
  const std::int64_t stride = config.stride();
  height = (height + stride - 1) / stride * stride;
  width = (width + stride - 1) / stride * stride;
  const std::int64_t full_area = height * width;
  std::int64_t area = full_area;
  std::int64_t macs = 0;
  // A strided convolution costs per output pixel, a transposed one per input pixel.
  const auto add = [&](const Layer& layer) {
    if (layer.is_residual()) {
      macs += 2 * 9 * layer.in_channels * layer.in_channels * area;
      return;
    }
    const std::int64_t weights = layer.kernel * layer.kernel * layer.in_channels * layer.out_channels;
    const std::int64_t factor = layer.stride * layer.stride;
    if (!layer.transposed) {
      area /= factor;
    }
    macs += weights * area;
    if (layer.transposed) {
      area *= factor;
    }
  };
  for (const auto part : {Part::kEncoder, Part::kDecoder}) {
    for (const auto& layer : table.part(part)) {
      add(layer);
    }
  }
  for (std::size_t i = 0; i < table.heads.size(); ++i) {
    area = full_area / (i == 0 ? 16 : 4);
    add(table.heads[i]);
  }
  for (std::size_t i = 0; i < table.skips.size(); ++i) {
    area = full_area >> (2 * (i + 1));
    add(table.skips[i]);
  }
  if (!table.matching.empty()) {
    const auto& frame_layers = table.matching;
    for (int frame = 0; frame < 2; ++frame) {
      area = full_area;
      for (std::size_t i = 0; i + 1 < frame_layers.size(); ++i) {
        add(frame_layers[i]);
      }
    }
    const auto& joining = frame_layers.back();
    macs += joining.in_channels * frame_layers[frame_layers.size() - 2].out_channels * area;  // the scalar products
    add(joining);
  }
  return macs;
}

}  // namespace ajna::nn
