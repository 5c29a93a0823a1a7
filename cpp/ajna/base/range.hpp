// SPDX-License-Identifier: MIT
#pragma once

#include <string>

#include "ajna/base/error.hpp"

namespace ajna {

/// Throw Error(kInvalidArgument) where `value` of the option `name` is not within [low, high], or is no number.
inline void require_between(const std::string& name, double value, double low, double high) {
  if (!(value >= low && value <= high)) {
    throw_invalid(name + " = " + std::to_string(value) + ": give " + std::to_string(low) + " to " +
                  std::to_string(high));
  }
}

}  // namespace ajna
