// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <vector>

namespace ajna::io {

using Bytes = std::vector<std::uint8_t>;

/// The whole of a regular file. Throws Error: kFileNotFound where nothing is there, kInvalidArgument for a folder, a
/// device or pipe, an empty file and a file above `max_bytes`, kRuntime where the system refuses to read it.
Bytes read_file(const std::filesystem::path& path, std::size_t max_bytes);

}  // namespace ajna::io
