// SPDX-License-Identifier: MIT
#include "ajna/base/conformal.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <sstream>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna {
namespace {

std::string text(double value) {
  std::ostringstream stream;
  stream << value;
  return stream.str();
}

}  // namespace

std::array<double, 2> ConformalFactors::at(double p) const {
  // Written so that NaN fails too.
  if (levels.empty() || !(p >= levels.front() && p <= levels.back())) {
    const std::string known =
        levels.empty() ? "there are none" : "they reach from " + text(levels.front()) + " to " + text(levels.back());
    throw_invalid("interval share " + text(p) + " lies outside the calibrated levels (" + known +
                  "): choose one inside, or calibrate the model for it with `ajna calibrate MODEL --levels ...`");
  }
  const auto above = static_cast<std::size_t>(std::lower_bound(levels.begin(), levels.end(), p) - levels.begin());
  if (levels[above] == p) {
    return factors[above];
  }
  const double part = (p - levels[above - 1]) / (levels[above] - levels[above - 1]);
  std::array<double, 2> result{};
  for (std::size_t axis = 0; axis < result.size(); ++axis) {
    result[axis] = factors[above - 1][axis] + part * (factors[above][axis] - factors[above - 1][axis]);
  }
  return result;
}

void ConformalFactors::check() const {
  if (levels.empty() || levels.size() != factors.size()) {
    throw_invalid("calibration has " + std::to_string(levels.size()) + " interval levels and " +
                  std::to_string(factors.size()) + " pairs of factors: give one pair for each of at least one level");
  }
  for (std::size_t i = 0; i < levels.size(); ++i) {
    if (!(levels[i] > (i == 0 ? 0.0 : levels[i - 1]) && levels[i] < 1.0)) {
      throw_invalid("interval level " + std::to_string(i) + " is " + text(levels[i]) +
                    ": give strictly rising shares inside (0, 1)");
    }
    for (std::size_t axis = 0; axis < 2; ++axis) {
      const double least = i == 0 ? 0.0 : factors[i - 1][axis];
      if (!std::isfinite(factors[i][axis]) || factors[i][axis] < least) {
        throw_invalid("interval factor of level " + text(levels[i]) + " is " + text(factors[i][axis]) +
                      ": factors are finite, not negative, and do not fall with the level");
      }
    }
  }
}

}  // namespace ajna
