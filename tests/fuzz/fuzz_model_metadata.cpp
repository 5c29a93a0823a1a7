// SPDX-License-Identifier: MIT
// The header of a checkpoint and the strings inside a TorchScript file: what is read of a model before its weights.
#include <string_view>

#include "ajna/base/error.hpp"
#include "ajna/nn/safetensors_header.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const std::string_view text(reinterpret_cast<const char*>(data), size);
  try {
    // What was read can be written, and read again as the same.
    const auto header = ajna::nn::parse_safetensors_header(text);
    const auto again = ajna::nn::parse_safetensors_header(ajna::nn::format_safetensors_header(header));
    if (again.metadata != header.metadata || again.tensors.size() != header.tensors.size()) {
      __builtin_trap();
    }
  } catch (const ajna::Error&) {
  }
  try {
    const auto strings = ajna::nn::parse_string_map(text);
    if (ajna::nn::parse_string_map(ajna::nn::format_string_map(strings)) != strings) {
      __builtin_trap();
    }
  } catch (const ajna::Error&) {
  }
  return 0;
}
