// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

namespace ajna::synth {

/// Photometric changes of B pictures; each [B] float32 on the pictures' device.
struct ColorChange {
  torch::Tensor brightness;  ///< added, white = 1
  torch::Tensor contrast;    ///< factor on the distance to the mean
  torch::Tensor hue;         ///< turn, a full circle = 1
  torch::Tensor saturation;  ///< factor
  torch::Tensor gamma;       ///< exponent
};

/// Apply the changes in the order of their fields, each clamped to [0, 1]. `image` float [B, 3, H, W] in [0, 1] RGB;
/// `mean` [B, 3]: the colour that contrast leaves as it is, before the change of brightness.
torch::Tensor change_color(const torch::Tensor& image, const torch::Tensor& mean, const ColorChange& change);

/// Turn the hue by `turn` [B] circles and scale the saturation by `factor` [B], in HSV. image float [B, 3, H, W] in [0,
/// 1].
torch::Tensor turn_hue(const torch::Tensor& image, const torch::Tensor& turn, const torch::Tensor& factor);

}  // namespace ajna::synth
