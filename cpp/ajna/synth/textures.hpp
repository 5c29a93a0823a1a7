// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>
#include <optional>

#include "ajna/synth/random.hpp"

namespace ajna::synth {

/// Which textures a bank holds beyond the general mix.
struct TextureMix {
  double flat = 0.0;        ///< share of nearly uniform textures
  double repetitive = 0.0;  ///< share of stripes and checks
};

/// A bank of square textures that scenes sample from: multi-octave noise, dead leaves, stripes, checks, gradients,
/// flat patches, and crops of photographs where given.
class TextureBank {
 public:
  /// `count` procedural textures of `size` x `size` from `seed`, followed by `photos`: uint8 [N, 3, size, size] RGB.
  /// Throws Error(kInvalidArgument) for photos of another shape or dtype.
  TextureBank(std::int64_t count, std::int64_t size, std::uint64_t seed, const torch::Device& device,
              const std::optional<torch::Tensor>& photos = std::nullopt, const TextureMix& mix = {});

  [[nodiscard]] std::int64_t procedural_count() const noexcept { return procedural_; }
  [[nodiscard]] std::int64_t photo_count() const noexcept { return photos_; }
  [[nodiscard]] std::int64_t size() const noexcept { return size_; }

  /// Bilinear look-up with mirrored continuation. `index` int64 [B, L]; u, v: texture pixels, float [B, L, H, W].
  /// Returns [B, L, 3, H, W] in [0, 1].
  [[nodiscard]] torch::Tensor sample(const torch::Tensor& index, const torch::Tensor& u, const torch::Tensor& v) const;

  /// The textures themselves, float [N, 3, size, size] in [0, 1]: for contact sheets and tests.
  [[nodiscard]] torch::Tensor textures() const;

 private:
  std::int64_t procedural_ = 0, photos_ = 0, size_ = 0;
  torch::Tensor bank_;  // [1, 3, N * size, size]: one tall picture, so that a look-up copies no texture
};

/// One procedural texture of the general mix, float [3, size, size] in [0, 1].
torch::Tensor make_texture(std::int64_t size, Random& random);

}  // namespace ajna::synth
