// SPDX-License-Identifier: MIT
#include "ajna/nn/torchscript.hpp"

#include <torch/csrc/jit/frontend/tracer.h>
#include <torch/csrc/jit/passes/freeze_module.h>
#include <torch/script.h>

#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/nn/folded_net.hpp"
#include "ajna/nn/preprocess.hpp"
#include "ajna/nn/random_state_guard.hpp"
#include "ajna/nn/safetensors_header.hpp"

namespace ajna::nn {
namespace {

namespace jit = torch::jit;
using CompilationUnit = std::shared_ptr<jit::CompilationUnit>;

/// Sizes are read inside the script, because a size that is read in C++ becomes a constant of the trace.
constexpr const char* kScript = R"(
def forward(self, x: Tensor) -> Tensor:
    assert x.dim() == 4 and x.size(1) == 6, "give the network input as [N, 6, H, W]"
    height = x.size(2)
    width = x.size(3)
    pad_y = (self.stride - height % self.stride) % self.stride
    pad_x = (self.stride - width % self.stride) % self.stride
    if pad_y > 0 or pad_x > 0:
        x = torch.replication_pad2d(x, [0, pad_x, 0, pad_y])
    y = self.net.forward(x)
    return torch.slice(torch.slice(y, 2, 0, height), 3, 0, width)

def predict(self, frame1: Tensor, frame2: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    assert frame1.dim() == 4 and frame1.size(1) == 3, "give frame 1 as RGB [N, 3, H, W] with values 0 to 255"
    assert frame2.size() == frame1.size(), "give two frames of equal size"
    y = self.forward(self.preprocess.forward(frame1, frame2))
    uncertainty, expected_error = self.table.forward(torch.slice(y, 1, 2, 4))
    return torch.slice(y, 1, 0, 2) * self.flow_scale, uncertainty, expected_error * self.flow_scale
)";

jit::Module make_module(const std::string& name, const CompilationUnit& unit) {
  jit::Module module(c10::QualifiedName("__torch__.ajna." + name), unit, /*shouldMangle=*/true);
  module.register_attribute("training", c10::BoolType::get(), false);
  return module;
}

/// Record `function` as the method `forward` of `self`, whose tensors it may use.
void trace_forward(jit::Module& self, jit::Stack inputs, const std::vector<std::string>& names,
                   const std::function<c10::IValue(const jit::Stack&)>& function) {
  const auto traced = jit::tracer::trace(
      std::move(inputs), [&](const jit::Stack& stack) { return jit::Stack{function(stack)}; },
      [](const torch::Tensor&) { return std::string(); }, /*strict=*/true, /*force_outplace=*/false, &self, names);
  const auto& type = self.type();
  auto* method = self._ivalue()->compilation_unit()->create_function(c10::QualifiedName(*type->name(), "forward"),
                                                                     traced.first->graph);
  type->addMethod(method);
}

jit::Module build_script(const FoldedNet& net, const Metadata& metadata) {
  const auto unit = std::make_shared<jit::CompilationUnit>();
  const std::int64_t side = 2 * metadata.net.stride();

  auto traced_net = make_module("FlowNet", unit);
  const auto tensors = net.tensors();
  for (std::size_t i = 0; i < tensors.size(); ++i) {
    traced_net.register_buffer("tensor" + std::to_string(i), tensors[i]);
  }
  trace_forward(traced_net, {torch::zeros({1, 6, side, side})}, {"x"},
                [&](const jit::Stack& x) { return net.forward_aligned(x[0].toTensor()); });

  auto preprocess = make_module("Preprocess", unit);
  const auto frame = torch::zeros({1, 3, side, side}, torch::kUInt8);
  trace_forward(preprocess, {frame, frame.clone()}, {"frame1", "frame2"},
                [](const jit::Stack& x) { return network_input(x[0].toTensor(), x[1].toTensor()); });

  auto table = make_module("UncertaintyTable", unit);
  table.register_buffer("uncertainty", metadata.table.uncertainty);
  table.register_buffer("expected_error", metadata.table.expected_error);
  trace_forward(table, {torch::zeros({1, 2, side, side})}, {"raw"}, [&](const jit::Stack& x) {
    auto values = metadata.table.evaluate(x[0].toTensor());
    return c10::ivalue::Tuple::create({values.uncertainty, values.expected_error});
  });

  auto script = make_module("Model", unit);
  script.register_attribute("stride", c10::IntType::get(), metadata.net.stride());
  script.register_attribute("flow_scale", c10::FloatType::get(), metadata.flow_scale);
  script.register_module("net", traced_net);
  script.register_module("preprocess", preprocess);
  script.register_module("table", table);
  script.define(kScript);
  return jit::freeze_module(script, {"predict"});
}

void require_equal(const torch::Tensor& script, const torch::Tensor& module, const std::string& what) {
  const double scale = module.abs().max().item<double>();
  const double difference = (script - module).abs().max().item<double>();
  // Written so that NaN fails too. The graph runs the same operations, so what remains is float32 rounding.
  if (script.sizes() != module.sizes() || !(difference <= 1e-5 * scale)) {
    throw_runtime("exported " + what + " differs from the network by " + std::to_string(difference) +
                  " (largest value " + std::to_string(scale) +
                  "): this torch version traces it wrongly; please report it");
  }
}

/// Read the file back and compare both methods with the C++ code, at the traced size and at others.
void verify(const std::string& path, const FoldedNet& net, const Metadata& metadata) {
  auto script = jit::load(path);
  const RandomStateGuard random_state;
  const std::int64_t stride = metadata.net.stride();
  const std::vector<std::vector<std::int64_t>> sizes{
      {1, 3, 2 * stride, 2 * stride}, {2, 3, stride, 3 * stride}, {1, 3, stride + 3, 2 * stride - 5}};
  for (const auto& size : sizes) {
    const auto frame1 = torch::randint(256, size, torch::kUInt8), frame2 = torch::randint(256, size, torch::kUInt8);
    const auto input = network_input(frame1, frame2);
    const auto output = net.forward(input);
    const auto values = metadata.table.evaluate(output.slice(1, 2, 4));
    require_equal(script.forward({input}).toTensor(), output, "method 'forward'");
    const auto predicted = script.get_method("predict")({frame1, frame2}).toTuple();
    const auto& parts = predicted->elements();
    require_equal(parts[0].toTensor(), output.slice(1, 0, 2) * metadata.flow_scale, "flow of 'predict'");
    require_equal(parts[1].toTensor(), values.uncertainty, "uncertainty of 'predict'");
    require_equal(parts[2].toTensor(), values.expected_error * metadata.flow_scale, "expected error of 'predict'");
  }
}

}  // namespace

void export_torchscript(const FlowNetImpl& net, const Metadata& metadata, const std::string& path) {
  if (metadata.net.in_channels != 6 || metadata.net.out_channels != 4 || !(metadata.net == net.config())) {
    throw_invalid("model '" + metadata.name + "' has " + std::to_string(net.config().in_channels) + " input and " +
                  std::to_string(net.config().out_channels) +
                  " output channels: only networks from two RGB frames (6) to flow and uncertainty (4) are exported");
  }
  metadata.table.check();
  const auto strings = format_string_map(metadata_to_strings(metadata));
  const torch::NoGradGuard no_grad;
  const FoldedNet folded(net, torch::kCPU, torch::kFloat32);
  Metadata on_cpu = metadata;
  on_cpu.table = metadata.table.to(torch::kCPU);
  write_atomically(path, [&](const std::string& temporary) {
    try {
      build_script(folded, on_cpu).save(temporary, {{kScriptMetadataFile, strings}});
      verify(temporary, folded, on_cpu);
    } catch (const c10::Error& error) {
      throw_runtime("TorchScript file '" + path + "' cannot be written: " + error.what_without_backtrace());
    }
  });
}

}  // namespace ajna::nn
