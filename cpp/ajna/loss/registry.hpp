// SPDX-License-Identifier: MIT
#pragma once

#include <cmath>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/loss/terms.hpp"

/// How terms are looked up by name; only the sources of this library include it.
namespace ajna::loss::registry {

/// A registered term: its parameters with their defaults, and how to make it (value and, for scalars, slope).
template <class Made>
struct Entry {
  TermParams defaults;
  std::function<Made(const TermParams&)> make;
};
template <class Made>
using Registry = std::map<std::string, Entry<Made>>;

struct Scalar {
  ScalarFunction value, slope;
};

template <class Made>
std::vector<std::string> names(const Registry<Made>& entries) {
  std::vector<std::string> result;
  for (const auto& [name, entry] : entries) {
    result.push_back(name);
  }
  return result;
}

/// `params` over `defaults`; throws for parameters that `what` ("loss term h 'inv'") does not have.
inline TermParams merged(const std::string& what, const TermParams& defaults, const TermParams& params) {
  TermParams result = defaults;
  std::vector<std::string> known;
  for (const auto& [name, value] : defaults) {
    known.push_back(name);
  }
  for (const auto& [name, value] : params) {
    if (defaults.find(name) == defaults.end()) {
      if (known.empty()) {
        throw_invalid(what + " takes no parameters: remove '" + name + "'");
      }
      throw_unknown("parameter of " + what, name, known);
    }
    if (!std::isfinite(value)) {
      throw_invalid("parameter '" + name + "' of " + what + " is not finite: give a number");
    }
    result[name] = value;
  }
  return result;
}

template <class Made>
std::pair<Made, TermParams> build(const Registry<Made>& entries, const std::string& kind, const TermSpec& spec) {
  const auto found = entries.find(spec.name);
  if (found == entries.end()) {
    throw_unknown(kind, spec.name, names(entries));
  }
  auto params = merged(kind + " '" + spec.name + "'", found->second.defaults, spec.params);
  return {found->second.make(params), std::move(params)};
}

/// `params.at(name)` where it is above 0; throws otherwise.
inline double positive(const TermParams& params, const std::string& name, const std::string& what) {
  const double value = params.at(name);
  if (value <= 0) {
    throw_invalid("parameter '" + name + "' of " + what + " is " + std::to_string(value) + ": give a number above 0");
  }
  return value;
}

const Registry<ErrorFunction>& error_terms();
const Registry<Scalar>& attenuations();
const Registry<Scalar>& penalties();
const Registry<Scalar>& parametrizations();

}  // namespace ajna::loss::registry
