// SPDX-License-Identifier: MIT
#pragma once

#include <map>
#include <optional>
#include <string>

#include "ajna/nn/calibration.hpp"
#include "ajna/nn/flow_net.hpp"
#include "ajna/nn/net_config.hpp"
#include "ajna/nn/uncertainty_table.hpp"

namespace ajna::nn {

/// Everything besides the weights that is needed to run a trained network, and where it comes from.
struct Metadata {
  std::string name;                               ///< for example "ajna-best"; not empty
  NetConfig net;                                  ///< shape of the network
  double flow_scale = 1.0;                        ///< network output x flow_scale = pixels; finite, > 0
  std::string loss;                               ///< the loss it was trained with, one line, for people
  UncertaintyTable table;                         ///< what raw means
  std::map<std::string, std::string> provenance;  ///< data, steps, code version, date, scores ...: free text
  /// Where the table's expected_error was fitted on held-out data: the intervals that go with it.
  std::optional<Calibration> calibration;
};

/// A network in eval mode, in float32 on the CPU, with its metadata.
struct Checkpoint {
  FlowNet net{nullptr};
  Metadata metadata;
};

/// Write a checkpoint, atomically: a safetensors file with the network's parameters and buffers under their module
/// names, the tables as `table.uncertainty` and `table.expected_error`, and flat strings in `__metadata__`.
///
/// Throws Error(kInvalidArgument) where `path` does not end in .safetensors, metadata.net is not the network's,
/// a field of the metadata is out of range, or a weight is not float32 or not finite.
void save_checkpoint(const std::string& path, const FlowNetImpl& net, const Metadata& metadata);

/// Read a checkpoint, strictly: a missing, surplus or misshapen tensor, an unknown version or key, a value out of range
/// and anything that is not such a file throw Error(kInvalidArgument) in one sentence; a missing file
/// Error(kFileNotFound). Executes no code from the file, allocates no more than the file's size justifies, and leaves
/// the global random state as it was.
Checkpoint load_checkpoint(const std::string& path);

/// The metadata (without the curves of the table) as flat strings, as both file formats carry them: "format",
/// "version", "name", "loss", "flow_scale", "net.<option>", "table.raw_min", "table.raw_step", "provenance.<key>", and,
/// where calibrated, "calibration.version", "calibration.levels", "calibration.factors_u", "calibration.factors_v" and
/// "calibration.provenance.<key>".
std::map<std::string, std::string> metadata_to_strings(const Metadata& metadata);
/// The inverse; strict. The curves of the result's table are undefined.
Metadata metadata_from_strings(const std::map<std::string, std::string>& strings);

}  // namespace ajna::nn
