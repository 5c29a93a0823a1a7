// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>

#include "ajna/synth/random.hpp"
#include "ajna/synth/scene_config.hpp"

namespace ajna::synth {

/// Where the layers of B scenes stand before a pinhole camera. Camera frame of frame 1: x right, y down, z forward; the
/// unit of length is the background's depth. A pixel (u, v) sees along x = ((u - cx) / f, (v - cy) / f, 1).
struct SceneGeometry {
  torch::Tensor plane;         ///< m, [B, L, 3] float64: the layer's plane is {X : m . X = 1}, its inverse depth m . x
  torch::Tensor focal_px;      ///< f, [B] float64
  double center_x, center_y;   ///< cx, cy: the image centre, pixels
  double width_px, height_px;  ///< size of the image
  torch::Tensor horizon_y;     ///< [B] float32, pixels: the floor (layer 1) lies below; undefined without a floor
  torch::Tensor floor_plane;   ///< [B, 3] float64: m of the floor; undefined without one

  /// m . x of each layer at the rays through its points (u, v) [B, L]; float64.
  [[nodiscard]] torch::Tensor inverse_depth(const torch::Tensor& u, const torch::Tensor& v) const;
  /// The largest inverse depth within the image of each layer, [B, L] float64.
  [[nodiscard]] torch::Tensor largest_inverse_depth() const;
  [[nodiscard]] SceneGeometry slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const;
};

/// A camera's way from frame 1 to frame 2, in the camera frame of frame 1: its displacement, in units of the
/// background's depth, and its rotation vector. [B, 3] float64 each.
struct CameraStep {
  torch::Tensor translation, rotation;
};

/// Number of layers that draw_geometry expects: background, floor where there is one, and config.layers.
std::int64_t layer_count(const SceneConfig& config);

/// Draw the planes of B scenes, farthest first; only where config.camera is not "off".
SceneGeometry draw_geometry(const SceneConfig& config, std::int64_t batch, std::int64_t height, std::int64_t width,
                            Random& random);

/// Draw the camera's way. `magnitude_px` [B]: displacement in the image of something at the middle depth.
CameraStep draw_camera_step(const SceneConfig& config, const SceneGeometry& geometry, const torch::Tensor& magnitude_px,
                            Random& random);

/// How the step moves the image of each layer: X2 = R^T (X1 - T) with m . X1 = 1 gives the homography
///   H = K R^T (I - T m^T) K^-1,  [B, L, 3, 3] float64, pixels of frame 1 to pixels of frame 2.
/// For small steps this is the motion field of the paper's Eq. 14 with V = T and Omega = the rotation vector.
torch::Tensor step_homographies(const SceneGeometry& geometry, const CameraStep& step);

/// Texture coordinates that lie on the layers' planes.
struct PlaneTexture {
  torch::Tensor q_u, q_v;  ///< [B, L, H, W]: coordinates on the plane, about one per pixel where it is nearest
  torch::Tensor density;   ///< [B, L, H, W]: coordinates per pixel in the direction of the strongest foreshortening
};

/// `u`, `v` [B, L, H, W]: pixels of frame 1.
PlaneTexture on_planes(const SceneGeometry& geometry, const torch::Tensor& u, const torch::Tensor& v);

}  // namespace ajna::synth
