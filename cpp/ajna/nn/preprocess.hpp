// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

namespace ajna::nn {

/// Two frames -> network input, the only pre-processing anywhere: x / 127.5 - 1, frame 1's RGB before frame 2's.
///
/// frame1, frame2: [N, 3, H, W] RGB on one device, uint8 or floating point with values 0..255.
/// Returns float32 [N, 6, H, W] in [-1, 1]. Throws Error(kInvalidArgument) for other shapes or dtypes.
torch::Tensor network_input(const torch::Tensor& frame1, const torch::Tensor& frame2);

}  // namespace ajna::nn
