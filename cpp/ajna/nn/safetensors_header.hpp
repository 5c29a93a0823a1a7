// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace ajna::nn {

/// What a safetensors header says of one tensor; bytes [begin, end) count from the end of the header.
struct TensorEntry {
  std::string dtype;                ///< as written: "F32", "I64", ...
  std::vector<std::int64_t> shape;  ///< every side >= 0
  std::uint64_t begin = 0, end = 0;
};

struct SafetensorsHeader {
  std::map<std::string, TensorEntry> tensors;
  std::map<std::string, std::string> metadata;  ///< the flat strings of "__metadata__"
};

/// Parse the JSON header of a safetensors file: exactly the subset that the format defines, nothing more.
///
/// The text is treated as hostile: no recursion, no number beyond 2^63 - 1, no duplicate keys, no unknown fields,
/// at most 8 sides per tensor; nothing is allocated beyond the size of the text. Sizes are not yet compared with
/// the file. Throws Error(kInvalidArgument) with the byte at which the text breaks the format.
SafetensorsHeader parse_safetensors_header(std::string_view text);

/// The inverse, with keys in alphabetical order. Names and metadata must be UTF-8.
std::string format_safetensors_header(const SafetensorsHeader& header);

/// The same for a flat JSON object of strings, {"key": "value", ...}, which a TorchScript file carries as ajna.json.
std::map<std::string, std::string> parse_string_map(std::string_view text);
std::string format_string_map(const std::map<std::string, std::string>& strings);

}  // namespace ajna::nn
