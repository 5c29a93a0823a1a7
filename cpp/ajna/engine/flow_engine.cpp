// SPDX-License-Identifier: MIT
#include "ajna/engine/flow_engine.hpp"

#include <ATen/Parallel.h>
#include <torch/torch.h>

#include <charconv>
#include <cmath>
#include <filesystem>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/engine/predictor.hpp"

namespace ajna::engine {
namespace {

constexpr int kMaxThreads = 1024;

torch::Device parse_device(const std::string& name) {
  if (name == "cpu") {
    return torch::kCPU;
  }
  int index = 0;
  const bool numbered = name.rfind("cuda:", 0) == 0;
  if (numbered) {
    const auto [end, failure] = std::from_chars(name.data() + 5, name.data() + name.size(), index);
    if (failure != std::errc() || end != name.data() + name.size() || index < 0) {
      throw_invalid("device '" + name + "': give 'cpu', 'cuda' or 'cuda:<index>'");
    }
  } else if (name != "cuda") {
    throw_invalid("device '" + name + "': give 'cpu', 'cuda' or 'cuda:<index>'");
  }
  const int count = torch::cuda::is_available() ? static_cast<int>(torch::cuda::device_count()) : 0;
  if (index >= count) {
    throw_runtime("device '" + name + "' is not there: this torch sees " + std::to_string(count) +
                  " CUDA devices; use 'cpu'" + (count > 0 ? " or a lower index" : " or install torch with CUDA"));
  }
  return {torch::kCUDA, static_cast<c10::DeviceIndex>(index)};
}

/// First line of LibTorch's text, which goes on with a stack trace.
std::string first_line(const c10::Error& error) {
  const std::string text = error.what_without_backtrace();
  return text.substr(0, text.find('\n'));
}

std::string size_text(const ImageView& view) { return std::to_string(view.width) + "x" + std::to_string(view.height); }

void check_frame(const ImageView& view, const std::string& name) {
  if (view.empty()) {
    throw_invalid(name + " is empty (" + size_text(view) + "): give an image with pixels");
  }
  if (view.channels != 3) {
    throw_invalid(name + " has " + std::to_string(view.channels) + " channels: give RGB with 3");
  }
  if (view.row_stride < static_cast<std::ptrdiff_t>(view.width) * view.channels) {
    throw_invalid(name + " has rows " + std::to_string(view.row_stride) + " bytes apart, less than its " +
                  std::to_string(view.width) + " pixels need: set row_stride to at least width * 3");
  }
}

/// [3, H, W] over the caller's memory, without a copy.
torch::Tensor wrap(const ImageView& view) {
  // LibTorch has no const tensors; nothing writes here.
  return torch::from_blob(const_cast<std::uint8_t*>(view.data), {3, view.height, view.width},
                          {1, view.row_stride, view.channels}, torch::kUInt8);
}

torch::Tensor stack_frames(const std::vector<FramePair>& pairs, ImageView FramePair::*frame, torch::Device device) {
  if (pairs.size() == 1) {
    return wrap(pairs[0].*frame).unsqueeze(0).to(device);
  }
  std::vector<torch::Tensor> frames;
  frames.reserve(pairs.size());
  for (const auto& pair : pairs) {
    frames.push_back(wrap(pair.*frame));
  }
  return torch::stack(frames).to(device);
}

/// [2, H, W] -> interleaved in `out`.
void copy_plane(const torch::Tensor& plane, std::vector<float>& out) {
  const auto interleaved = plane.permute({1, 2, 0});
  out.resize(static_cast<std::size_t>(plane.numel()));
  torch::from_blob(out.data(), interleaved.sizes(), torch::kFloat32).copy_(interleaved);
}

}  // namespace

struct FlowEngine::Impl {
  std::unique_ptr<Predictor> predictor;
  ModelInfo info;
  std::shared_ptr<const ConformalFactors> conformal;  // null where the model is not calibrated
  torch::Device device{torch::kCPU};
  std::int64_t max_pixels = 0;

  void check(const std::vector<FramePair>& pairs) const;
  /// results: one field per pair, whose memory is used again.
  void infer(const std::vector<FramePair>& pairs, FlowField* results) const;
};

void FlowEngine::Impl::check(const std::vector<FramePair>& pairs) const {
  const ImageView& first = pairs[0].frame1;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const std::string place = pairs.size() == 1 ? "" : " of pair " + std::to_string(i);
    check_frame(pairs[i].frame1, "frame 1" + place);
    check_frame(pairs[i].frame2, "frame 2" + place);
    for (const auto* view : {&pairs[i].frame1, &pairs[i].frame2}) {
      if (view->width != first.width || view->height != first.height) {
        throw_invalid("frame " + std::string(view == &pairs[i].frame1 ? "1" : "2") + place + " is " + size_text(*view) +
                      " but frame 1 is " + size_text(first) + ": give frames of equal size");
      }
    }
  }
  const auto pixels = static_cast<std::int64_t>(first.width) * first.height;
  if (pixels > max_pixels / static_cast<std::int64_t>(pairs.size())) {
    throw_invalid("frames of " + size_text(first) + " in a batch of " + std::to_string(pairs.size()) + " exceed " +
                  std::to_string(max_pixels) + " pixels: give smaller frames or raise max_pixels");
  }
}

void FlowEngine::Impl::infer(const std::vector<FramePair>& pairs, FlowField* results) const {
  check(pairs);
  const c10::InferenceMode inference;
  try {
    auto output = predictor->predict(stack_frames(pairs, &FramePair::frame1, device),
                                     stack_frames(pairs, &FramePair::frame2, device));
    // NaN and infinity survive a sum; one pass instead of a mask.
    const auto total = output.flow.sum() + output.uncertainty.sum() + output.expected_error.sum();
    if (!std::isfinite(total.item<float>())) {
      throw_runtime("model '" + info.name + "' gave NaN or infinite values for frames of " +
                    size_text(pairs[0].frame1) + ": its weights are damaged or the precision is too low");
    }
    output = {output.flow.cpu(), output.uncertainty.cpu(), output.expected_error.cpu()};
    for (std::size_t i = 0; i < pairs.size(); ++i) {
      const auto n = static_cast<std::int64_t>(i);
      FlowField& field = results[i];
      field.width = pairs[i].frame1.width;
      field.height = pairs[i].frame1.height;
      field.timestamp_s = pairs[i].timestamp_s;
      field.conformal = conformal;
      copy_plane(output.flow[n], field.flow);
      copy_plane(output.uncertainty[n], field.uncertainty);
      copy_plane(output.expected_error[n], field.expected_error);
    }
  } catch (const c10::Error& error) {
    throw_runtime("model '" + info.name + "' failed on " + info.device + " for frames of " +
                  size_text(pairs[0].frame1) + ": " + first_line(error));
  } catch (const std::bad_alloc&) {
    throw_runtime("not enough memory for frames of " + size_text(pairs[0].frame1) + ": give smaller ones");
  }
}

FlowEngine FlowEngine::load(const std::string& path, const EngineOptions& options) {
  if (options.threads < 0 || options.threads > kMaxThreads) {
    throw_invalid("threads = " + std::to_string(options.threads) + ": give 0 to " + std::to_string(kMaxThreads));
  }
  if (options.max_pixels < 1) {
    throw_invalid("max_pixels = " + std::to_string(options.max_pixels) + ": give at least 1");
  }
  const std::string extension = std::filesystem::path(path).extension().string();
  const bool is_checkpoint = extension == ".safetensors";
  if (!is_checkpoint && extension != ".pt" && extension != ".torchscript") {
    throw_invalid("model file '" + path +
                  "': give a checkpoint (.safetensors) or a TorchScript file (.pt, .torchscript)");
  }
  if (!is_checkpoint && options.bfloat16) {
    throw_invalid("model file '" + path +
                  "': bfloat16 needs a checkpoint (.safetensors); a TorchScript file has its "
                  "precision fixed");
  }
  auto impl = std::make_unique<Impl>();
  impl->device = parse_device(options.device);
  impl->max_pixels = options.max_pixels;
  LoadedModel model;
  try {
    model = is_checkpoint ? load_checkpoint_model(path, impl->device, options.bfloat16)
                          : load_torchscript_model(path, impl->device);
  } catch (const c10::Error& error) {
    throw_runtime("model file '" + path + "' cannot be put on " + options.device + ": " + first_line(error));
  }
  impl->predictor = std::move(model.predictor);
  const nn::Metadata& metadata = model.metadata;
  impl->info = {metadata.name,
                path,
                is_checkpoint ? "checkpoint" : "torchscript",
                impl->device.str(),
                model.precision,
                metadata.loss,
                metadata.flow_scale,
                nn::count_parameters(metadata.net),
                metadata.net.stride(),
                {{"in_channels", metadata.net.in_channels},
                 {"out_channels", metadata.net.out_channels},
                 {"width", metadata.net.width},
                 {"expansion", metadata.net.expansion},
                 {"sub_blocks", metadata.net.sub_blocks},
                 {"skip_connections", metadata.net.skip_connections},
                 {"scale_heads", metadata.net.scale_heads},
                 {"correlation_radius", metadata.net.correlation_radius}},
                metadata.provenance,
                metadata.calibration.has_value(),
                {},
                {}};
  if (metadata.calibration) {
    impl->conformal = std::make_shared<const ConformalFactors>(metadata.calibration->factors);
    impl->info.interval_levels = impl->conformal->levels;
    impl->info.calibration = metadata.calibration->provenance;
  }
  // Last, so that a failed load leaves the process as it was.
  if (options.threads > 0) {
    at::set_num_threads(options.threads);
  }
  return FlowEngine(std::move(impl));
}

FlowEngine::FlowEngine(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
FlowEngine::FlowEngine(FlowEngine&&) noexcept = default;
FlowEngine& FlowEngine::operator=(FlowEngine&&) noexcept = default;
FlowEngine::~FlowEngine() = default;

FlowField FlowEngine::infer(const ImageView& frame1, const ImageView& frame2, double timestamp_s) const {
  FlowField field;
  infer_into(frame1, frame2, field, timestamp_s);
  return field;
}

void FlowEngine::infer_into(const ImageView& frame1, const ImageView& frame2, FlowField& field,
                            double timestamp_s) const {
  const std::vector<FramePair> pair(1, FramePair{frame1, frame2, timestamp_s});
  impl_->infer(pair, &field);
}

std::vector<FlowField> FlowEngine::infer_batch(const std::vector<FramePair>& pairs) const {
  if (pairs.empty()) {
    return {};
  }
  std::vector<FlowField> fields(pairs.size());
  impl_->infer(pairs, fields.data());
  return fields;
}

void FlowEngine::warm_up(int width, int height, int batch, int runs) const {
  if (batch < 1 || runs < 0) {
    throw_invalid("warm-up with batch " + std::to_string(batch) + " and " + std::to_string(runs) +
                  " runs: give a batch of at least 1 and no negative number of runs");
  }
  const Image black(width, height);
  const std::vector<FramePair> pairs(static_cast<std::size_t>(batch), FramePair{black.view(), black.view()});
  for (int i = 0; i < runs; ++i) {
    infer_batch(pairs);
  }
}

const ModelInfo& FlowEngine::info() const noexcept { return impl_->info; }

}  // namespace ajna::engine
