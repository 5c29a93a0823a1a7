// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "ajna/base/flow_field.hpp"
#include "ajna/base/image_view.hpp"

namespace ajna::engine {

struct EngineOptions {
  std::string device = "cpu";  ///< "cpu", "cuda" or "cuda:<index>"
  int threads = 0;             ///< LibTorch's threads within one operation, for the whole process; 0: leave as it is
  bool bfloat16 = false;       ///< run the network in bfloat16: faster where the processor has it, about 2 digits
  std::int64_t max_pixels = std::int64_t{1} << 24;  ///< largest batch x height x width that is accepted
};

/// What a loaded model is and where it comes from.
struct ModelInfo {
  std::string name;                               ///< as given when it was saved
  std::string path;                               ///< the file it was loaded from
  std::string format;                             ///< "checkpoint" or "torchscript"
  std::string device;                             ///< where it runs
  std::string precision;                          ///< "float32" or "bfloat16"
  std::string loss;                               ///< the loss it was trained with
  double flow_scale = 1.0;                        ///< network output x flow_scale = pixels
  std::int64_t parameters = 0;                    ///< learnable numbers
  std::int64_t stride = 1;                        ///< sides are padded to a multiple of this
  std::map<std::string, std::int64_t> network;    ///< the options of nn::NetConfig by name
  std::map<std::string, std::string> provenance;  ///< data, steps, date ...: free text
  bool calibrated = false;              ///< whether expected errors and intervals were fitted on held-out data
  std::vector<double> interval_levels;  ///< shares that FlowField::interval was calibrated for; else empty
  std::map<std::string, std::string> calibration;  ///< data, images, pixels, date ... of the calibration; else empty
};

struct FramePair {
  ImageView frame1, frame2;
  double timestamp_s = 0.0;  ///< capture time of frame 2
};

/// Two frames in, flow and uncertainty out. LibTorch stays behind this header.
///
/// Calls from several threads at once are safe; they share LibTorch's threads, so one engine per process is the rule.
class FlowEngine {
 public:
  /// Load a checkpoint (.safetensors) or a TorchScript file (.pt, .torchscript) written by this library. A checkpoint
  /// executes no code from the file; TorchScript is a program: load it only from where you would run one.
  /// Throws Error: kFileNotFound for a missing file, kInvalidArgument for a foreign or damaged one and for an option
  /// out of range, kRuntime where the device is not there.
  static FlowEngine load(const std::string& path, const EngineOptions& options = {});

  FlowEngine(FlowEngine&&) noexcept;
  FlowEngine& operator=(FlowEngine&&) noexcept;
  ~FlowEngine();

  /// Flow from frame 1 to frame 2 in pixels, on frame 1's grid; any size, both the same.
  /// Throws Error(kInvalidArgument) for empty frames, channels other than 3, unequal or too large sizes, and
  /// Error(kRuntime) where the network gives NaN or infinite values or the device fails.
  FlowField infer(const ImageView& frame1, const ImageView& frame2, double timestamp_s = 0.0) const;
  /// The same into `field`, whose memory is used again where its size fits: for loops without allocation of results.
  void infer_into(const ImageView& frame1, const ImageView& frame2, FlowField& field, double timestamp_s = 0.0) const;
  /// Pairs of one size through the network together; equal to one by one up to float32 rounding.
  std::vector<FlowField> infer_batch(const std::vector<FramePair>& pairs) const;
  /// Run on black frames, because the first runs at a size are slow.
  void warm_up(int width, int height, int batch = 1, int runs = 2) const;

  [[nodiscard]] const ModelInfo& info() const noexcept;

 private:
  struct Impl;
  explicit FlowEngine(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace ajna::engine
