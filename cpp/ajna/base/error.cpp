// SPDX-License-Identifier: MIT
#include "ajna/base/error.hpp"

#include <algorithm>
#include <numeric>

namespace ajna {
namespace {

std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), std::size_t{0});
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t substituted = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substituted});
    }
  }
  return row[b.size()];
}

}  // namespace

void throw_invalid(const std::string& message) { throw Error(ErrorKind::kInvalidArgument, message); }

void throw_not_found(const std::string& path, const std::string& remedy) {
  throw Error(ErrorKind::kFileNotFound, "file '" + path + "' does not exist: " + remedy);
}

void throw_runtime(const std::string& message) { throw Error(ErrorKind::kRuntime, message); }

std::string nearest_name(std::string_view name, const std::vector<std::string>& candidates) {
  std::string best;
  std::size_t best_distance = std::min<std::size_t>(3, std::max<std::size_t>(1, name.size() / 2)) + 1;
  for (const auto& candidate : candidates) {
    const std::size_t distance = edit_distance(name, candidate);
    if (distance < best_distance) {
      best_distance = distance;
      best = candidate;
    }
  }
  return best;
}

void throw_unknown(std::string_view kind, std::string_view name, const std::vector<std::string>& known) {
  std::string message = "unknown " + std::string(kind) + " '" + std::string(name) + "'";
  if (const std::string near = nearest_name(name, known); !near.empty()) {
    message += ", did you mean '" + near + "'?";
  }
  message += " Known: ";
  for (std::size_t i = 0; i < known.size(); ++i) {
    message += (i == 0 ? "" : ", ") + known[i];
  }
  throw_invalid(message);
}

}  // namespace ajna
