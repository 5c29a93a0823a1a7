// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace ajna::flight {

/// Builds one JSON object on one line. Numbers that are not finite become null; text is escaped.
class JsonLine {
 public:
  JsonLine& add(std::string_view key, double value);
  JsonLine& add(std::string_view key, std::int64_t value);
  JsonLine& add(std::string_view key, std::uint64_t value) { return add(key, static_cast<std::int64_t>(value)); }
  JsonLine& add(std::string_view key, int value) { return add(key, static_cast<std::int64_t>(value)); }
  JsonLine& add(std::string_view key, bool value);
  JsonLine& add(std::string_view key, std::string_view value);
  JsonLine& add(std::string_view key, const char* value) { return add(key, std::string_view(value)); }
  JsonLine& add(std::string_view key, const std::vector<double>& values);
  JsonLine& add_null(std::string_view key);
  /// The object, without a line break.
  [[nodiscard]] std::string str() const { return text_ + "}"; }

 private:
  void begin(std::string_view key);
  std::string text_ = "{";
};

/// `text` in quotes, escaped.
std::string json_string(std::string_view text);

}  // namespace ajna::flight
