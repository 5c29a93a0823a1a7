// SPDX-License-Identifier: MIT
#pragma once

#include <array>
#include <vector>

namespace ajna {

/// What split-conformal calibration on held-out images gives: how far flow intervals reach, in units of the expected
/// error. The interval of an axis with share p is flow -+ at(p)[axis] * expected_error.
struct ConformalFactors {
  std::vector<double> levels;                  ///< shares, strictly rising, inside (0, 1)
  std::vector<std::array<double, 2>> factors;  ///< per level for u and v: finite, >= 0, not falling with the level

  /// The factors of u and v at share `p`, linear between the stored levels.
  /// Throws Error(kInvalidArgument) where p lies outside them.
  [[nodiscard]] std::array<double, 2> at(double p) const;
  /// Throws Error(kInvalidArgument) that names the first field which breaks what is stated above.
  void check() const;
};

inline bool operator==(const ConformalFactors& a, const ConformalFactors& b) {
  return a.levels == b.levels && a.factors == b.factors;
}

}  // namespace ajna
