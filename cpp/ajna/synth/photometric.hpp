// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>

#include "ajna/synth/random.hpp"
#include "ajna/synth/scene_config.hpp"

namespace ajna::synth {

/// What happens to the rendered frames of B scenes on their way through a camera. All [B] or [B, 3] float32.
struct CameraEffects {
  torch::Tensor shutter;         ///< open time as a fraction of the frame interval; 0 = no motion blur
  torch::Tensor defocus_px;      ///< Gaussian sigma; 0 = sharp
  torch::Tensor noise;           ///< standard deviation, in units of 1 = white
  torch::Tensor gain1, gain2;    ///< [B, 3] per frame and channel
  torch::Tensor gamma1, gamma2;  ///< [B] per frame

  [[nodiscard]] CameraEffects slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;
};

/// `extra` draws what only some options need (exposure jumps); by default `random`.
CameraEffects draw_camera_effects(const SceneConfig& config, std::int64_t batch, Random& random,
                                  Random* extra = nullptr);

/// Lamps on the background that shine in one of the two frames.
struct Lights {
  torch::Tensor x, y, sigma;  ///< [B, K], pixels of frame 1; undefined where there are none
  torch::Tensor color;        ///< [B, K, 3], light added at the centre
  torch::Tensor on;           ///< [B, K, 2] float 0 or 1: in frame 1, in frame 2

  [[nodiscard]] Lights slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;
  /// Light added to frame 1 or 2 at points (x, y) [B, H, W] of frame 1: [B, 3, H, W].
  [[nodiscard]] torch::Tensor glow(const torch::Tensor& at_x, const torch::Tensor& at_y, int frame) const;
};

Lights draw_lights(const SceneConfig& config, std::int64_t batch, std::int64_t height, std::int64_t width,
                   Random& random);

/// Average `image` [B, 3, H, W] along the displacement (vx, vy) [B, H, W] in pixels, over the shutter time around it.
torch::Tensor motion_blur(const torch::Tensor& image, const torch::Tensor& vx, const torch::Tensor& vy,
                          const torch::Tensor& shutter);

/// Gaussian blur with one sigma per scene; borders mirrored.
torch::Tensor defocus(const torch::Tensor& image, const torch::Tensor& sigma_px);

/// gain * image^gamma + noise, rounded to uint8 [B, 3, H, W].
torch::Tensor expose(const torch::Tensor& image, const torch::Tensor& gain, const torch::Tensor& gamma,
                     const torch::Tensor& noise);

}  // namespace ajna::synth
