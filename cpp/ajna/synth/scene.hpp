// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>
#include <optional>

#include "ajna/synth/camera_motion.hpp"
#include "ajna/synth/motion.hpp"
#include "ajna/synth/photometric.hpp"
#include "ajna/synth/scene_config.hpp"
#include "ajna/synth/shapes.hpp"
#include "ajna/synth/textures.hpp"

namespace ajna::synth {

/// How a layer looks up its texture: texture pixel = scale * rotation * image pixel + offset, then gain and bias.
struct Appearance {
  torch::Tensor index;       ///< int64 [B, L] into the bank
  torch::Tensor affine;      ///< [B, L, 4]: scale * cos, scale * sin, offset u, offset v
  torch::Tensor gain, bias;  ///< [B, L, 3]
  torch::Tensor lit;         ///< [B, L, 2]: factor on the colour in frame 1 and in frame 2; undefined without blinking
};

/// Everything that was drawn for B scenes with L layers each.
struct Scene {
  std::int64_t batch, layers, height, width;
  LayerPlacement place;   ///< [B, L]
  torch::Tensor present;  ///< [B, L] float 0 or 1
  ShapeSet shapes;
  LayerMotion motion;
  Appearance look;
  CameraEffects camera;
  Lights lights;
  std::optional<SceneGeometry> geometry;  ///< where a camera moves through the scene

  /// Scenes [begin, end), on `device`.
  [[nodiscard]] Scene slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;
};

/// Draw B scenes on the CPU. Equal (config, bank sizes, seed, shape) give equal scenes.
Scene draw_scene(const SceneConfig& config, const TextureBank& bank, std::int64_t batch, std::int64_t height,
                 std::int64_t width, std::uint64_t seed);

}  // namespace ajna::synth
