// SPDX-License-Identifier: MIT
#include "ajna/flight/json_line.hpp"

#include <array>
#include <cmath>
#include <cstdio>

namespace ajna::flight {
namespace {

std::string number(double value) {
  if (!std::isfinite(value)) {
    return "null";
  }
  std::array<char, 32> buffer{};
  const int size = std::snprintf(buffer.data(), buffer.size(), "%.9g", value);
  return {buffer.data(), static_cast<std::size_t>(size)};
}

}  // namespace

std::string json_string(std::string_view text) {
  std::string out = "\"";
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      out += '\\';
      out += c;
    } else if (byte < 0x20 || byte >= 0x7f) {
      // Bytes of any encoding: a reader gets ASCII.
      std::array<char, 8> buffer{};
      std::snprintf(buffer.data(), buffer.size(), "\\u%04x", static_cast<unsigned>(byte));
      out += buffer.data();
    } else {
      out += c;
    }
  }
  return out + '"';
}

void JsonLine::begin(std::string_view key) {
  if (text_.size() > 1) {
    text_ += ", ";
  }
  text_ += json_string(key);
  text_ += ": ";
}

JsonLine& JsonLine::add(std::string_view key, double value) {
  begin(key);
  text_ += number(value);
  return *this;
}

JsonLine& JsonLine::add(std::string_view key, std::int64_t value) {
  begin(key);
  text_ += std::to_string(value);
  return *this;
}

JsonLine& JsonLine::add(std::string_view key, bool value) {
  begin(key);
  text_ += value ? "true" : "false";
  return *this;
}

JsonLine& JsonLine::add(std::string_view key, std::string_view value) {
  begin(key);
  text_ += json_string(value);
  return *this;
}

JsonLine& JsonLine::add(std::string_view key, const std::vector<double>& values) {
  begin(key);
  text_ += "[";
  for (std::size_t i = 0; i < values.size(); ++i) {
    text_ += (i == 0 ? "" : ", ") + number(values[i]);
  }
  text_ += "]";
  return *this;
}

JsonLine& JsonLine::add_null(std::string_view key) {
  begin(key);
  text_ += "null";
  return *this;
}

}  // namespace ajna::flight
