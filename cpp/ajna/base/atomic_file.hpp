// SPDX-License-Identifier: MIT
#pragma once

#include <functional>
#include <string>

namespace ajna {

/// Write `path` so that a reader sees the old file or the whole new one, never a part.
///
/// `write` gets a temporary name in the same folder, with the same extension, and must create that file; on return it
/// is renamed over `path`. Where `write` throws, the temporary file is removed and the exception passes through.
/// Throws Error(kFileNotFound) where the folder does not exist, Error(kInvalidArgument) where `path` is a folder,
/// and Error(kRuntime) where the folder cannot be written or the rename fails.
void write_atomically(const std::string& path, const std::function<void(const std::string& temporary)>& write);

}  // namespace ajna
