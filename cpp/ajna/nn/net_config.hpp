// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>

namespace ajna::nn {

/// Shape of the residual encoder-decoder; the defaults are the paper's network (2,724,980 parameters).
///
/// The last three fields add to it what a plain encoder-decoder lacks; 0 leaves each out.
struct NetConfig {
  std::int64_t in_channels = 6;   ///< two RGB frames
  std::int64_t out_channels = 4;  ///< u, v, raw uncertainty of u, of v
  std::int64_t width = 32;        ///< channels after the first convolution
  std::int64_t expansion = 2;     ///< channel factor of each further down-sampling
  std::int64_t sub_blocks = 2;    ///< residual block + down-sampling pairs after the two strided stem convolutions

  /// 1: what the encoder gives at 1/2 and 1/4 of the size is added, through a 1x1 convolution each, to the decoder's
  /// output of that size.
  std::int64_t skip_connections = 0;
  /// 1: predictions at 1/4 and 1/2 of the size too, each correcting the enlarged one before it, as in the authors'
  /// later EdgeFlowNet.
  std::int64_t scale_heads = 0;
  /// R > 0: both frames' features at 1/8 of the size are compared over displacements up to R cells along each axis, and
  /// the (2 R + 1)^2 similarities join the encoder there.
  std::int64_t correlation_radius = 0;

  /// Both sides of the input must be multiples of this; FlowNet pads and crops by itself.
  [[nodiscard]] std::int64_t stride() const noexcept { return std::int64_t{4} << sub_blocks; }
};

inline bool operator==(const NetConfig& a, const NetConfig& b) noexcept {
  return a.in_channels == b.in_channels && a.out_channels == b.out_channels && a.width == b.width &&
         a.expansion == b.expansion && a.sub_blocks == b.sub_blocks && a.skip_connections == b.skip_connections &&
         a.scale_heads == b.scale_heads && a.correlation_radius == b.correlation_radius;
}

}  // namespace ajna::nn
