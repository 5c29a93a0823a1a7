// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cstdint>

#include "ajna/synth/augment_config.hpp"

namespace ajna::synth {

/// B frame pairs with ground truth, all on one device; members that are not given are undefined tensors. What ends in
/// `_backward` lies on frame 2's grid and concerns the way from frame 2 to frame 1.
struct LabelledPairs {
  torch::Tensor frame1, frame2;                             ///< uint8 [B, 3, H, W] RGB
  torch::Tensor flow, flow_backward;                        ///< float32 [B, 2, H, W], pixels
  torch::Tensor valid, valid_backward;                      ///< bool [B, 1, H, W]: where the flow is known
  torch::Tensor occlusion, occlusion_backward;              ///< bool [B, 1, H, W]: hidden or outside the other frame
  torch::Tensor motion_boundary, motion_boundary_backward;  ///< bool [B, 1, H, W]
};

/// Random changes of colour and geometry of frame pairs, their flow and their masks.
///
/// With A1 and A2 the affine maps from pixels of the augmented frames to pixels of the given ones, the new flow at p is
/// A2^-1 (x + flow(x)) - p at x = A1 p. Flow is interpolated within surfaces and taken from the nearest pixel across
/// their edges. Points whose target leaves the crop or lies under a patch become occluded. Flow is valid where the
/// given one is valid and finite and x lies inside the frame; elsewhere it is 0.
/// Batched tensor code on the pairs' device; equal seeds give equal bits on a CPU.
class Augmenter {
 public:
  /// Throws Error(kInvalidArgument) for an option out of range.
  explicit Augmenter(const AugmentConfig& config);

  /// Augmented crops of `height` x `width`, with `valid` (and `valid_backward`, given a backward flow) always defined.
  /// Throws Error(kInvalidArgument) for tensors of another shape, type or device, a crop below 1x1, or where frames
  /// would be swapped without backward flow, or without the backward mask of each mask that is given.
  [[nodiscard]] LabelledPairs augment(const LabelledPairs& pairs, std::int64_t height, std::int64_t width,
                                      std::uint64_t seed) const;

  [[nodiscard]] const AugmentConfig& config() const noexcept { return config_; }

 private:
  AugmentConfig config_;
};

}  // namespace ajna::synth
