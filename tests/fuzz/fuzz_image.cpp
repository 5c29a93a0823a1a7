// SPDX-License-Identifier: MIT
// Image files: PNG, JPEG, BMP, PPM and PGM, recognised by their content.
#include "ajna/base/error.hpp"
#include "ajna/io/image_io.hpp"
#include "memory_file.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const MemoryFile file(data, size);
  try {
    const auto image = ajna::io::read_image(file.path());
    if (image.size_bytes() != static_cast<std::size_t>(image.width()) * static_cast<std::size_t>(image.height()) * 3) {
      __builtin_trap();
    }
  } catch (const ajna::Error&) {
  }
  return 0;
}
