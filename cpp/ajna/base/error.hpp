// SPDX-License-Identifier: MIT
#pragma once

#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace ajna {

/// What went wrong, in the terms in which a caller can react.
enum class ErrorKind {
  kInvalidArgument,  ///< a value that cannot be used: ValueError in Python
  kFileNotFound,     ///< a path that does not exist: FileNotFoundError in Python
  kRuntime,          ///< the machine failed: full disk, unwritable folder, lost device: RuntimeError in Python
};

/// The one exception of the library: one sentence that names the thing, the offending value and the remedy.
class Error : public std::runtime_error {
 public:
  Error(ErrorKind kind, const std::string& message) : std::runtime_error(message), kind_(kind) {}
  [[nodiscard]] ErrorKind kind() const noexcept { return kind_; }

 private:
  ErrorKind kind_;
};

/// Throw Error(kInvalidArgument): "<what> <value>: <remedy>", for example
/// "image 'a.png' is 320x240 but 'b.png' is 640x480: give two images of equal size".
[[noreturn]] void throw_invalid(const std::string& message);
/// Throw Error(kFileNotFound): "file '<path>' does not exist: <remedy>".
[[noreturn]] void throw_not_found(const std::string& path, const std::string& remedy);
/// Throw Error(kRuntime).
[[noreturn]] void throw_runtime(const std::string& message);

/// The candidate nearest to `name` by edit distance, or an empty string where none is near (more than 3 edits, or
/// more than half of the name). For "did you mean" hints.
std::string nearest_name(std::string_view name, const std::vector<std::string>& candidates);
/// Throw kInvalidArgument for an unknown `name` of a `kind` ("loss term f"), with the nearest and all known names.
[[noreturn]] void throw_unknown(std::string_view kind, std::string_view name, const std::vector<std::string>& known);

}  // namespace ajna
