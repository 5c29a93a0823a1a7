// SPDX-License-Identifier: MIT
// Flow files: .flo, .pfm and KITTI's PNG; the first byte chooses.
#include "ajna/base/error.hpp"
#include "ajna/io/flow_io.hpp"
#include "ajna/io/pfm_io.hpp"
#include "memory_file.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size == 0) {
    return 0;
  }
  const MemoryFile file(data + 1, size - 1);
  try {
    switch (data[0] % 3) {
      case 0: {
        const auto flow = ajna::io::read_flo(file.path());
        if (flow.flow.size() != 2 * flow.valid.size()) {
          __builtin_trap();
        }
        break;
      }
      case 1:
        ajna::io::read_pfm(file.path());
        break;
      default:
        ajna::io::read_kitti_flow(file.path());
    }
  } catch (const ajna::Error&) {
  }
  return 0;
}
