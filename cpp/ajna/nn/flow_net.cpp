// SPDX-License-Identifier: MIT
#include "ajna/nn/flow_net.hpp"

#include <string>
#include <vector>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

namespace F = torch::nn::functional;

/// One row of the network's table: a convolution unit, or a residual block where kernel is 0.
struct Layer {
  std::int64_t in_channels, out_channels, kernel, stride;
  bool transposed, activated;
  [[nodiscard]] bool is_residual() const { return kernel == 0; }
};

struct LayerTable {
  std::vector<Layer> encoder, decoder;
};

/// The table of layers (rows 1 to 13 for the paper's options).
LayerTable layer_table(const NetConfig& c) {
  LayerTable table;
  std::int64_t channels = c.width;
  table.encoder.push_back({c.in_channels, channels, 7, 2, false, true});
  table.encoder.push_back({channels, channels * c.expansion, 5, 2, false, true});
  channels *= c.expansion;
  for (std::int64_t i = 0; i < c.sub_blocks; ++i) {
    table.encoder.push_back({channels, channels, 0, 1, false, true});
    table.encoder.push_back({channels, channels * c.expansion, 3, 2, false, false});
    channels *= c.expansion;
  }
  for (std::int64_t i = 0; i < c.sub_blocks; ++i) {
    table.decoder.push_back({channels, channels, 0, 1, true, true});
    table.decoder.push_back({channels, channels / c.expansion, 3, 2, true, false});
    channels /= c.expansion;
  }
  table.decoder.push_back({channels, c.width, 5, 2, true, true});
  table.decoder.push_back({c.width, c.width / 2, 7, 2, true, true});
  table.decoder.push_back({c.width / 2, c.out_channels, 7, 1, true, false});
  return table;
}

void check_config(const NetConfig& c) {
  const auto require = [](bool ok, const char* name, std::int64_t value, const char* remedy) {
    if (!ok) {
      throw_invalid(std::string("network option ") + name + " = " + std::to_string(value) + ": " + remedy);
    }
  };
  require(c.in_channels >= 1, "in_channels", c.in_channels, "give at least 1");
  require(c.out_channels >= 1, "out_channels", c.out_channels, "give at least 1");
  require(c.width >= 2 && c.width % 2 == 0 && c.width <= 1024, "width", c.width, "give an even number from 2 to 1024");
  require(c.expansion >= 1 && c.expansion <= 4, "expansion", c.expansion, "give 1 to 4");
  require(c.sub_blocks >= 0 && c.sub_blocks <= 4, "sub_blocks", c.sub_blocks, "give 0 to 4");
}

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
  check_config(config);
  const LayerTable table = layer_table(config);
  encoder_ = register_module("encoder", torch::nn::ModuleList());
  decoder_ = register_module("decoder", torch::nn::ModuleList());
  append_layers(encoder_, table.encoder);
  append_layers(decoder_, table.decoder);
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

torch::Tensor FlowNetImpl::forward_aligned(torch::Tensor x) {
  for (const auto& part : {encoder_, decoder_}) {
    for (const auto& layer : *part) {
      x = run_layer(*layer, x);
    }
  }
  return x;
}

std::vector<torch::Tensor> FlowNetImpl::forward_layers(torch::Tensor x) {
  std::vector<torch::Tensor> activations;
  for (const auto& part : {encoder_, decoder_}) {
    for (const auto& layer : *part) {
      x = run_layer(*layer, x);
      activations.push_back(x);
    }
  }
  return activations;
}

std::int64_t count_parameters(const torch::nn::Module& module) {
  std::int64_t count = 0;
  for (const auto& parameter : module.parameters()) {
    count += parameter.numel();
  }
  return count;
}

std::int64_t count_parameters(const NetConfig& config) {
  check_config(config);
  const LayerTable table = layer_table(config);
  std::int64_t count = 0;
  for (const auto* layers : {&table.encoder, &table.decoder}) {
    for (const auto& layer : *layers) {
      const std::int64_t c = layer.out_channels;
      count += layer.is_residual()
                   ? 2 * (9 * c * c + 3 * c)
                   : layer.kernel * layer.kernel * layer.in_channels * c + (layer.activated ? 3 * c : c);
    }
  }
  return count;
}

std::int64_t count_macs(const NetConfig& config, std::int64_t height, std::int64_t width) {
  check_config(config);
  const std::int64_t stride = config.stride();
  height = (height + stride - 1) / stride * stride;
  width = (width + stride - 1) / stride * stride;
  std::int64_t macs = 0;
  const LayerTable table = layer_table(config);
  const auto add = [&](const Layer& layer) {
    if (layer.is_residual()) {
      macs += 2 * 9 * layer.in_channels * layer.in_channels * height * width;
      return;
    }
    const std::int64_t weights = layer.kernel * layer.kernel * layer.in_channels * layer.out_channels;
    // A strided convolution costs per output pixel, a transposed one per input pixel.
    if (!layer.transposed) {
      height /= layer.stride;
      width /= layer.stride;
    }
    macs += weights * height * width;
    if (layer.transposed) {
      height *= layer.stride;
      width *= layer.stride;
    }
  };
  for (const auto& layer : table.encoder) {
    add(layer);
  }
  for (const auto& layer : table.decoder) {
    add(layer);
  }
  return macs;
}

}  // namespace ajna::nn
