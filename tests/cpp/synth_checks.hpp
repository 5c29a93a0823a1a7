// SPDX-License-Identifier: MIT
// What the tests of scenes and of augmentation share.
#pragma once

#include <torch/torch.h>

#include <cmath>
#include <cstdint>

#include "ajna/synth/pair_generator.hpp"

namespace ajna::synth::testing {

namespace F = torch::nn::functional;

/// Take from a scene all that is not geometry: blur, noise, exposure, blinking.
inline SceneConfig cleaned(SceneConfig config) {
  config.bank_size = 12;
  config.texture_size = 96;
  config.blur_probability = 0;
  config.defocus_probability = 0;
  config.noise_max = 0;
  config.brightness_change = 0;
  config.color_change = 0;
  config.gamma_change = 0;
  config.blink_probability = 0;
  config.light_probability = 0;
  config.jump_probability = 0;
  return config;
}

/// `image` [B, C, H, W] looked up at x + flow(x).
inline torch::Tensor warp(const torch::Tensor& image, const torch::Tensor& flow) {
  const auto height = image.size(2), width = image.size(3);
  const auto x = torch::arange(width, flow.options()).view({1, 1, -1}) + flow.select(1, 0);
  const auto y = torch::arange(height, flow.options()).view({1, -1, 1}) + flow.select(1, 1);
  const auto grid =
      torch::stack({x * 2 / static_cast<double>(width - 1) - 1, y * 2 / static_cast<double>(height - 1) - 1}, -1);
  return F::grid_sample(
      image.to(torch::kFloat32), grid,
      F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kBorder).align_corners(true));
}

/// True where every pixel within `radius` is true.
inline torch::Tensor eroded(const torch::Tensor& mask, std::int64_t radius) {
  const auto outside = F::max_pool2d(mask.logical_not().to(torch::kFloat32),
                                     F::MaxPool2dFuncOptions(2 * radius + 1).stride(1).padding(radius));
  return outside < 0.5;
}

struct OcclusionCheck {
  std::int64_t compared = 0, hidden = 0, wrong = 0;
};

/// Does the occlusion agree with what frame 2 shows? layer2 is composited on frame 2's grid, the occlusion is computed
/// at the exact target: two routes that must agree away from outlines.
inline OcclusionCheck check_occlusion(const PairBatch& pair) {
  const auto count = pair.flow.size(0), height = pair.flow.size(2), width = pair.flow.size(3);
  const auto flow = pair.flow.accessor<float, 4>();
  const auto layer1 = pair.layer1.accessor<std::uint8_t, 4>(), layer2 = pair.layer2.accessor<std::uint8_t, 4>();
  const auto occlusion = pair.occlusion.accessor<bool, 4>();
  OcclusionCheck result;
  for (std::int64_t b = 0; b < count; ++b) {
    for (std::int64_t y = 0; y < height; ++y) {
      for (std::int64_t x = 0; x < width; ++x) {
        const auto tx = static_cast<std::int64_t>(std::lround(static_cast<float>(x) + flow[b][0][y][x]));
        const auto ty = static_cast<std::int64_t>(std::lround(static_cast<float>(y) + flow[b][1][y][x]));
        if (tx < 1 || ty < 1 || tx >= width - 1 || ty >= height - 1) {
          continue;
        }
        const auto seen = layer2[b][0][ty][tx];
        bool uniform = true;
        for (int dy = -1; dy <= 1; ++dy) {
          for (int dx = -1; dx <= 1; ++dx) {
            uniform = uniform && layer2[b][0][ty + dy][tx + dx] == seen;
          }
        }
        if (!uniform) {
          continue;
        }
        ++result.compared;
        const bool expected = seen != layer1[b][0][y][x];
        result.hidden += expected ? 1 : 0;
        result.wrong += expected != occlusion[b][0][y][x] ? 1 : 0;
      }
    }
  }
  return result;
}

}  // namespace ajna::synth::testing
