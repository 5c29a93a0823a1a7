// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <vector>

#include "ajna/nn/net_config.hpp"

namespace ajna::nn {

/// One layer of the network: a convolution unit, or a residual block where kernel is 0.
struct Layer {
  std::int64_t in_channels, out_channels, kernel, stride;
  bool transposed, activated;
  [[nodiscard]] bool is_residual() const { return kernel == 0; }
};

/// The lists of layers that a network consists of; the last three are empty unless its config asks for them.
enum class Part {
  kEncoder,
  kDecoder,
  kHeads,     ///< at 1/4 and at 1/2 of the size
  kMatching,  ///< three that each frame passes alone, then the one from similarities to the encoder's channels
  kSkips,     ///< 1x1 convolutions from encoder to decoder at 1/2, 1/4 ... of the size
};
inline constexpr std::size_t kPartCount = 5;

/// Rows 1 to 13 of the network's table for the paper's options, and what the further options add.
struct LayerTable {
  std::vector<Layer> encoder, decoder, heads, matching, skips;
  [[nodiscard]] const std::vector<Layer>& part(Part part) const;
};

/// Throws Error(kInvalidArgument) where a field of `config` is out of range.
LayerTable layer_table(const NetConfig& config);

/// Name of a part's list in the network's module tree.
const char* part_name(Part part);

/// Runs layer `index` of `part`.
using RunLayer = std::function<torch::Tensor(Part part, std::size_t index, const torch::Tensor& x)>;

/// How the layers are wired, the one definition for training, tracing and inference alike. No size is read, so that a
/// trace of it holds for any size.
///
/// `x` [N, in_channels, H, W], sides multiples of config.stride(). Returns the predictions [N, out_channels, h, w] from
/// coarse to fine, the last at full size (the only one without scale_heads), all in the unit of the last.
/// `activations`, where given, receives what each layer of encoder and decoder hands on.
std::vector<torch::Tensor> run_graph(const NetConfig& config, torch::Tensor x, const RunLayer& run,
                                     std::vector<torch::Tensor>* activations = nullptr);

/// Similarity of `a` at each place with `b` at each displacement (dx, dy), |dx|, |dy| <= radius, zero outside:
/// [N, C, H, W] twice -> [N, (2 radius + 1)^2, H, W], channel (dy + radius) (2 radius + 1) + dx + radius; the scalar
/// product over the channels divided by sqrt(C).
torch::Tensor correlation(const torch::Tensor& a, const torch::Tensor& b, std::int64_t radius);

}  // namespace ajna::nn
