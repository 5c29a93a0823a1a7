// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <map>
#include <string>

namespace ajna::nn {

/// Named tensors and flat string metadata: the content of a safetensors file.
struct NamedTensors {
  std::map<std::string, torch::Tensor> tensors;
  std::map<std::string, std::string> metadata;
};

/// Read a safetensors file into CPU tensors. Never executes code and never allocates beyond the file's own size.
///
/// Throws Error(kFileNotFound) for a missing file, and Error(kInvalidArgument) with one sentence for a folder, an
/// empty, foreign or truncated file, a header that lies about sizes, gaps or overlaps of tensors, empty tensors, and
/// dtypes other than F64, F32, F16, BF16, I64, I32, I16, I8 and U8.
NamedTensors read_safetensors(const std::string& path);

/// Write atomically; tensors are copied to the CPU and made contiguous. Other programs' safetensors readers accept the
/// file. Throws Error for an unsupported dtype or a place that cannot be written.
void write_safetensors(const std::string& path, const NamedTensors& content);

}  // namespace ajna::nn
