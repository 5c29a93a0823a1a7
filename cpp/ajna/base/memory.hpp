// SPDX-License-Identifier: MIT
#pragma once

namespace ajna {

/// Lets the process keep memory that it frees, for programs that work frame by frame: by default glibc gives blocks as
/// large as a map back to the system, and every frame pays for their pages anew (a third to a half of a skill's time).
/// Call once, at the start of a program. False where the C library cannot be told so: nothing then changes.
bool keep_freed_memory() noexcept;

}  // namespace ajna
