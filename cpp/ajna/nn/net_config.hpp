// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>

namespace ajna::nn {

/// Shape of the residual encoder-decoder; the defaults are the paper's network (2,724,980 parameters).
struct NetConfig {
  std::int64_t in_channels = 6;   ///< two RGB frames
  std::int64_t out_channels = 4;  ///< u, v, raw uncertainty of u, of v
  std::int64_t width = 32;        ///< channels after the first convolution
  std::int64_t expansion = 2;     ///< channel factor of each further down-sampling
  std::int64_t sub_blocks = 2;    ///< residual block + down-sampling pairs after the two strided stem convolutions

  /// Both sides of the input must be multiples of this; FlowNet pads and crops by itself.
  [[nodiscard]] std::int64_t stride() const noexcept { return std::int64_t{4} << sub_blocks; }
};

inline bool operator==(const NetConfig& a, const NetConfig& b) noexcept {
  return a.in_channels == b.in_channels && a.out_channels == b.out_channels && a.width == b.width &&
         a.expansion == b.expansion && a.sub_blocks == b.sub_blocks;
}

}  // namespace ajna::nn
