// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>
#include <memory>
#include <optional>

#include "ajna/synth/scene_config.hpp"
#include "ajna/synth/textures.hpp"

namespace ajna::synth {

/// B synthetic frame pairs with exact ground truth on frame 1's grid, all on the generator's device.
struct PairBatch {
  torch::Tensor frame1, frame2;   ///< uint8 [B, 3, H, W] RGB
  torch::Tensor flow;             ///< float32 [B, 2, H, W], pixels: frame1(x) ~ frame2(x + flow(x))
  torch::Tensor occlusion;        ///< bool [B, 1, H, W]: visible in frame 1, hidden or outside the image in frame 2
  torch::Tensor motion_boundary;  ///< bool [B, 1, H, W]: next to a pixel of another layer that moves differently
  torch::Tensor layer1, layer2;   ///< uint8 [B, 1, H, W]: front-most layer in frame 1, in frame 2; 0 = background
};

/// Makes pairs: a background and several foreground layers with their own textures, outlines and motions, composited in
/// both frames, then seen through a camera (motion blur, defocus, exposure, noise).
///
/// Batched tensor code, the same on CPU and GPU. Equal (config, bank seed, photos, seed, shape) give equal bits on a
/// CPU.
class PairGenerator {
 public:
  /// Builds the texture bank. photos: uint8 [N, 3, texture_size, texture_size], optional.
  /// Throws Error(kInvalidArgument) for an option out of range or photos of another shape.
  explicit PairGenerator(const SceneConfig& config, std::uint64_t bank_seed = 0,
                         const torch::Device& device = torch::kCPU,
                         const std::optional<torch::Tensor>& photos = std::nullopt);

  /// Shares the textures of `other` and its device.
  /// Throws Error(kInvalidArgument) for an option out of range, or texture options other than those of `other`.
  PairGenerator(const SceneConfig& config, const PairGenerator& other);

  /// `flow_scale` multiplies flow_mean_px and flow_max_px (a curriculum's knob).
  /// Throws Error(kInvalidArgument) for a batch or side below 1, or a scale that is not finite and >= 0.
  [[nodiscard]] PairBatch generate(std::int64_t batch, std::int64_t height, std::int64_t width, std::uint64_t seed,
                                   double flow_scale = 1.0) const;

  [[nodiscard]] const SceneConfig& config() const noexcept { return config_; }
  [[nodiscard]] const TextureBank& bank() const noexcept { return *bank_; }

 private:
  SceneConfig config_;
  torch::Device device_;
  std::shared_ptr<const TextureBank> bank_;
};

}  // namespace ajna::synth
