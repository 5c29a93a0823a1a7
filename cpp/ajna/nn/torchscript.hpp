// SPDX-License-Identifier: MIT
#pragma once

#include <string>

#include "ajna/nn/checkpoint.hpp"

namespace ajna::nn {

/// Name of the extra file inside an exported script: metadata_to_strings() as a flat JSON object, calibration included.
inline constexpr const char* kScriptMetadataFile = "ajna.json";
/// Beside it where the network does not run in float32: "bfloat16".
inline constexpr const char* kScriptPrecisionFile = "ajna_precision.txt";

/// Write `net` as a frozen TorchScript file that needs nothing of Ajna to run, with two methods:
///   forward(x: [N, 6, H, W] float in [-1, 1]) -> [N, 4, H, W], what FlowNet::forward gives in eval mode;
///   predict(frame1, frame2: [N, 3, H, W] uint8 RGB) -> (flow, uncertainty, expected_error), each [N, 2, H, W] float32:
///     flow and expected error in pixels, uncertainty in the unit of the loss.
/// Both take any N, H and W. The file is for CPU and CUDA: choose with map_location (or load's device) when loading.
///
/// The written file is read back and compared with `net` at several sizes before it takes its name. `net` itself is
/// not changed, and may be in training mode or on another device. Throws Error(kInvalidArgument) where the network is
/// not 6 to 4 channels or the metadata do not fit it, Error(kRuntime) where the file cannot be written or differs.
void export_torchscript(const FlowNetImpl& net, const Metadata& metadata, const std::string& path);

}  // namespace ajna::nn
