// SPDX-License-Identifier: MIT
// Configuration files.
#include <string>

#include "ajna/base/error.hpp"
#include "apps/flight_config.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  try {
    ajna::apps::parse_config(std::string(reinterpret_cast<const char*>(data), size), "fuzz");
  } catch (const ajna::Error&) {
  }
  return 0;
}
