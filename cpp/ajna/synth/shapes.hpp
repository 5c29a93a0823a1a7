// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include "ajna/synth/random.hpp"
#include "ajna/synth/scene_config.hpp"

namespace ajna::synth {

/// The outlines of R layers as signed distances in local units (1 = layer radius), positive inside.
///
/// Blobs, polygons and plates are kept as rasters that are sampled bilinearly; bars and trees, whose ridge a raster
/// would lose, are evaluated as distances to line segments.
class ShapeSet {
 public:
  /// `extra` draws what only some options need, so that the other draws stay the same without them; by default
  /// `random`.
  ShapeSet(const SceneConfig& config, std::int64_t rows, Random& random, Random* extra = nullptr);

  /// Signed distance at local coordinates x, y: float [R, H, W] -> [R, H, W].
  [[nodiscard]] torch::Tensor signed_distance(const torch::Tensor& x, const torch::Tensor& y) const;

  /// bool [R]: plates, which reach far beyond their radius; on the CPU as drawn.
  [[nodiscard]] const torch::Tensor& unbounded() const noexcept { return unbounded_; }

  /// bool [R]: trees, which stand on their centre; on the CPU as drawn.
  [[nodiscard]] const torch::Tensor& upright() const noexcept { return upright_; }

  /// The shapes of rows [begin, end), on `device`.
  [[nodiscard]] ShapeSet slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;

 private:
  ShapeSet() = default;
  void plant_trees(Random& random);

  torch::Tensor raster_;     // [R, Q, Q] over [-kExtent, kExtent]^2
  torch::Tensor is_bar_;     // bool [R]
  torch::Tensor unbounded_;  // bool [R]
  torch::Tensor upright_;    // bool [R]
  torch::Tensor segments_;   // [R, S, 4]: x0, y0, x1, y1
  torch::Tensor radius_;     // [R, S]: half thickness of each segment
};

}  // namespace ajna::synth
