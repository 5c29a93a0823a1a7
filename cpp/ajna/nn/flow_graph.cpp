// SPDX-License-Identifier: MIT
#include "ajna/nn/flow_graph.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

/// Index of the encoder layer whose output has 1/8 of the size: the first down-sampling after the stem.
constexpr std::size_t kMatchingPlace = 3;
/// Matching layers that each frame passes; the one after them takes the similarities.
constexpr std::size_t kFrameLayers = 3;

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
  for (const auto& [name, value] :
       {std::pair{"skip_connections", c.skip_connections}, {"scale_heads", c.scale_heads}}) {
    require(value == 0 || value == 1, name, value, "give 0 or 1");
  }
  require(c.correlation_radius >= 0 && c.correlation_radius <= 8, "correlation_radius", c.correlation_radius,
          "give 0 (none) to 8");
  require(c.correlation_radius == 0 || (c.sub_blocks >= 1 && c.in_channels % 2 == 0), "correlation_radius",
          c.correlation_radius, "give 0, or at least 1 sub-block and an even number of input channels");
}

/// Encoder layers whose outputs are carried to the decoder: those of 1/2 and 1/4 of the size, where outlines are. One
/// of 1/8 would quadruple the weights of all connections.
constexpr std::int64_t kCarried = 2;

/// The decoder begins with the encoder's smallest output, so that one is never carried.
std::int64_t carried_layers(const NetConfig& config) { return std::min(kCarried, 1 + config.sub_blocks); }

Tensor enlarged(const Tensor& x) {
  return torch::upsample_bilinear2d(x, c10::nullopt, /*align_corners=*/false, std::vector<double>{2.0, 2.0});
}

Tensor matched(const NetConfig& config, const Tensor& frames, const RunLayer& run) {
  const auto features = [&](Tensor x) {
    for (std::size_t i = 0; i < kFrameLayers; ++i) {
      x = run(Part::kMatching, i, x);
    }
    return x;
  };
  const std::int64_t half = config.in_channels / 2;
  const auto a = features(frames.slice(1, 0, half)), b = features(frames.slice(1, half, 2 * half));
  return run(Part::kMatching, kFrameLayers, correlation(a, b, config.correlation_radius));
}

}  // namespace

const std::vector<Layer>& LayerTable::part(Part part) const {
  switch (part) {
    case Part::kEncoder:
      return encoder;
    case Part::kDecoder:
      return decoder;
    case Part::kHeads:
      return heads;
    case Part::kMatching:
      return matching;
    default:
      return skips;
  }
}

const char* part_name(Part part) {
  switch (part) {
    case Part::kEncoder:
      return "encoder";
    case Part::kDecoder:
      return "decoder";
    case Part::kHeads:
      return "heads";
    case Part::kMatching:
      return "matching";
    default:
      return "skips";
  }
}

LayerTable layer_table(const NetConfig& c) {
  check_config(c);
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
  if (c.scale_heads != 0) {
    table.heads.push_back({channels, c.out_channels, 3, 1, false, false});
    table.heads.push_back({c.width, c.out_channels, 3, 1, false, false});
  }
  table.decoder.push_back({channels, c.width, 5, 2, true, true});
  table.decoder.push_back({c.width, c.width / 2, 7, 2, true, true});
  table.decoder.push_back({c.width / 2, c.out_channels, 7, 1, true, false});
  if (c.skip_connections != 0) {
    std::int64_t carried = c.width;
    for (std::int64_t i = 0; i < carried_layers(c); ++i) {
      table.skips.push_back({carried, carried, 1, 1, false, false});
      carried *= c.expansion;
    }
  }
  if (const std::int64_t r = c.correlation_radius; r > 0) {
    table.matching.push_back({c.in_channels / 2, c.width / 2, 7, 2, false, true});
    table.matching.push_back({c.width / 2, c.width, 5, 2, false, true});
    table.matching.push_back({c.width, 2 * c.width, 3, 2, false, false});
    const std::int64_t joined = c.width * c.expansion * c.expansion;
    table.matching.push_back({(2 * r + 1) * (2 * r + 1), joined, 1, 1, false, false});
  }
  return table;
}

std::vector<Tensor> run_graph(const NetConfig& config, Tensor x, const RunLayer& run,
                              std::vector<Tensor>* activations) {
  const auto hand_on = [&](const Tensor& value) {
    if (activations != nullptr) {
      activations->push_back(value);
    }
  };
  const std::size_t encoder_size = 2 + 2 * static_cast<std::size_t>(config.sub_blocks);
  const std::size_t decoder_size = 3 + 2 * static_cast<std::size_t>(config.sub_blocks);
  const Tensor frames = x;
  std::vector<Tensor> skips;  // encoder outputs by falling size
  for (std::size_t i = 0; i < encoder_size; ++i) {
    x = run(Part::kEncoder, i, x);
    if (i == kMatchingPlace && config.correlation_radius > 0) {
      x = x + matched(config, frames, run);
    }
    if (config.skip_connections != 0 && i < static_cast<std::size_t>(carried_layers(config))) {
      skips.push_back(x);
    }
    hand_on(x);
  }
  std::vector<Tensor> predictions;
  const auto predict = [&](std::size_t head) {
    auto correction = run(Part::kHeads, head, x);
    predictions.push_back(predictions.empty() ? correction : correction + enlarged(predictions.back()));
  };
  const std::size_t quarter = decoder_size - 3;  // the layer that takes 1/4 of the size to 1/2
  for (std::size_t i = 0; i < decoder_size; ++i) {
    if (config.scale_heads != 0 && (i == quarter || i == quarter + 1)) {
      predict(i - quarter);
    }
    x = run(Part::kDecoder, i, x);
    if ((i == quarter || i + 1 == quarter) && !skips.empty()) {
      x = x + run(Part::kSkips, skips.size() - 1, skips.back());
      skips.pop_back();
    }
    if (i + 1 == decoder_size && !predictions.empty()) {
      x = x + enlarged(predictions.back());
    }
    hand_on(x);
  }
  predictions.push_back(x);
  return predictions;
}

Tensor correlation(const Tensor& a, const Tensor& b, std::int64_t radius) {
  const auto scaled = a / std::sqrt(static_cast<double>(a.size(1)));
  const auto padded = F::pad(b, F::PadFuncOptions({radius, radius, radius, radius}));
  // Ends count from the far side, so that no size enters a trace.
  const auto shifted = [radius](const Tensor& x, std::int64_t dim, std::int64_t by) {
    const std::int64_t end = by == 2 * radius ? std::numeric_limits<std::int64_t>::max() : by - 2 * radius;
    return x.slice(dim, by, end);
  };
  std::vector<Tensor> channels;
  channels.reserve(static_cast<std::size_t>((2 * radius + 1) * (2 * radius + 1)));
  for (std::int64_t dy = 0; dy <= 2 * radius; ++dy) {
    const auto rows = shifted(padded, 2, dy);
    for (std::int64_t dx = 0; dx <= 2 * radius; ++dx) {
      channels.push_back((scaled * shifted(rows, 3, dx)).sum(1, /*keepdim=*/true));
    }
  }
  return torch::cat(channels, 1);
}

}  // namespace ajna::nn
