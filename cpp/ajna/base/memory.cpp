// SPDX-License-Identifier: MIT
#include "ajna/base/memory.hpp"

#if defined(__GLIBC__) || __has_include(<malloc.h>)
#include <malloc.h>
#endif

namespace ajna {

bool keep_freed_memory() noexcept {
#ifdef M_MMAP_THRESHOLD
  constexpr int kLargestBlock = 32 << 20;  // the most that glibc takes
  constexpr int kKept = 512 << 20;
  return mallopt(M_MMAP_THRESHOLD, kLargestBlock) == 1 && mallopt(M_TRIM_THRESHOLD, kKept) == 1;
#else
  return false;
#endif
}

}  // namespace ajna
