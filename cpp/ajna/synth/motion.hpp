// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include "ajna/synth/camera_motion.hpp"
#include "ajna/synth/random.hpp"
#include "ajna/synth/scene_config.hpp"

namespace ajna::synth {

/// A pair of coordinate planes in pixels.
struct Points {
  torch::Tensor x, y;
};

/// How R layers move from frame 1 to frame 2. Frame 1 shows each layer in its canonical coordinates; with the
/// homography G and the smooth wave field n,
///   frame 2 -> frame 1:  q = G^-1 y,  x = q + n(q)
///   frame 1 -> frame 2:  q + n(q) = x by fixed-point iteration (|grad n| <= kMaxGradient), y = G q.
struct LayerMotion {
  static constexpr double kMaxGradient = 0.3;
  static constexpr int kIterations = 16;  // 0.3^16 = 4e-9 of the amplitude: below float32 rounding

  torch::Tensor forward;    ///< G, [R, 9]
  torch::Tensor backward;   ///< G^-1, [R, 9]
  torch::Tensor waves;      ///< [R, K, 5]: amplitude x, y; frequency x, y (rad/px); phase
  bool projective = false;  ///< some G has a perspective part
  bool nonrigid = false;    ///< some wave has an amplitude

  /// Where points of frame 2 were in frame 1: [R, H, W] or broadcastable planes in, [R, H, W] out.
  [[nodiscard]] Points to_frame1(const Points& y) const;
  /// Where points of frame 1 go in frame 2. Row r of the planes belongs to row r of the parameters.
  [[nodiscard]] Points to_frame2(const Points& x) const;

  /// The motion of one chosen row per pixel: `row` int64 [B, H, W] picks among the L rows of each scene.
  /// Rows are ordered [B * L]. The result's parameters have one value per pixel.
  [[nodiscard]] LayerMotion per_pixel(const torch::Tensor& row, std::int64_t layers) const;
  /// The same scenes with one row's motion taken out of all rows: `still` int64 [B], which of the `layers` rows, or -1
  /// for a scene that stays as it is. What is left of a layer's G is G_still^-1 G.
  [[nodiscard]] LayerMotion relative_to(const torch::Tensor& still, std::int64_t layers) const;
  [[nodiscard]] LayerMotion slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;
};

/// Sizes and places of the layers of B scenes; row 0 of each scene is the background.
struct LayerPlacement {
  torch::Tensor center_x, center_y;  ///< [B, L], pixels
  torch::Tensor radius;              ///< [B, L], pixels: the outline's unit
  torch::Tensor extent;              ///< [B, L], pixels: how far from the centre the layer can be seen
};

/// Draw the motions of B scenes with L layers each, rows ordered [B * L], nearest layer last. With a `geometry` the
/// camera moves, drawn from `extra`, and layers follow; by default layers move each on their own.
LayerMotion draw_motion(const SceneConfig& config, const LayerPlacement& placement, std::int64_t height,
                        std::int64_t width, Random& random, const SceneGeometry* geometry = nullptr,
                        Random* extra = nullptr);

}  // namespace ajna::synth
