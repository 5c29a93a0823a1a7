// SPDX-License-Identifier: MIT
#include "ajna/nn/safetensors_header.hpp"

#include <cstdio>
#include <limits>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

constexpr std::size_t kMaxSides = 8;

/// Strict UTF-8: no overlong forms, no surrogates, nothing above U+10FFFF.
bool is_utf8(std::string_view text) {
  constexpr std::uint32_t kSmallest[] = {0, 0, 0x80, 0x800, 0x10000};
  for (std::size_t i = 0; i < text.size();) {
    const auto lead = static_cast<unsigned char>(text[i]);
    const std::size_t length = lead < 0x80 ? 1 : lead >> 5 == 6 ? 2 : lead >> 4 == 14 ? 3 : lead >> 3 == 30 ? 4 : 0;
    if (length == 0 || length > text.size() - i) {
      return false;
    }
    std::uint32_t code = length == 1 ? lead : lead & (0x7FU >> length);
    for (std::size_t k = 1; k < length; ++k) {
      const auto byte = static_cast<unsigned char>(text[i + k]);
      if (byte >> 6 != 2) {
        return false;
      }
      code = code << 6 | (byte & 0x3FU);
    }
    if (code < kSmallest[length] || code > 0x10FFFF || (code >= 0xD800 && code <= 0xDFFF)) {
      return false;
    }
    i += length;
  }
  return true;
}

/// A cursor over the text; every method either consumes what it names or throws.
class Cursor {
 public:
  explicit Cursor(std::string_view text) : text_(text) {}

  [[noreturn]] void fail(const std::string& what) const {
    throw_invalid("its header breaks the format at byte " + std::to_string(position_) + ": " + what);
  }

  void skip_space() {
    while (position_ < text_.size() && (text_[position_] == ' ' || text_[position_] == '\t' ||
                                        text_[position_] == '\n' || text_[position_] == '\r')) {
      ++position_;
    }
  }
  [[nodiscard]] bool at_end() const { return position_ == text_.size(); }

  /// Consume `c` where it is next.
  bool accept(char c) {
    skip_space();
    if (position_ < text_.size() && text_[position_] == c) {
      ++position_;
      return true;
    }
    return false;
  }
  void expect(char c) {
    if (!accept(c)) {
      fail(std::string("expected '") + c + "'");
    }
  }

  std::string string() {
    expect('"');
    std::string result;
    while (true) {
      const char c = next();
      if (c == '"') {
        if (!is_utf8(result)) {
          fail("string is not UTF-8");
        }
        return result;
      }
      if (static_cast<unsigned char>(c) < 0x20) {
        fail("control character in a string");
      }
      if (c == '\\') {
        escape(result);
      } else {
        result.push_back(c);
      }
    }
  }

  /// A non-negative integer below 2^63, without sign, fraction, exponent or leading zeros.
  std::int64_t integer() {
    skip_space();
    constexpr std::int64_t kMax = std::numeric_limits<std::int64_t>::max();
    const std::size_t start = position_;
    std::int64_t value = 0;
    while (position_ < text_.size() && text_[position_] >= '0' && text_[position_] <= '9') {
      const int digit = text_[position_] - '0';
      if (value > (kMax - digit) / 10) {
        fail("number too large");
      }
      value = value * 10 + digit;
      ++position_;
    }
    if (position_ == start) {
      fail("expected a non-negative integer");
    }
    if (text_[start] == '0' && position_ - start > 1) {
      fail("number with leading zeros");
    }
    return value;
  }

 private:
  char next() {
    if (at_end()) {
      fail("string without an end");
    }
    return text_[position_++];
  }

  std::uint32_t hex4() {
    std::uint32_t value = 0;
    for (int i = 0; i < 4; ++i) {
      const char c = next();
      value <<= 4;
      if (c >= '0' && c <= '9') {
        value |= static_cast<std::uint32_t>(c - '0');
      } else if (c >= 'a' && c <= 'f') {
        value |= static_cast<std::uint32_t>(c - 'a' + 10);
      } else if (c >= 'A' && c <= 'F') {
        value |= static_cast<std::uint32_t>(c - 'A' + 10);
      } else {
        fail("bad \\u escape");
      }
    }
    return value;
  }

  void escape(std::string& out) {
    switch (const char c = next()) {
      case '"':
      case '\\':
      case '/':
        out.push_back(c);
        return;
      case 'b':
        out.push_back('\b');
        return;
      case 'f':
        out.push_back('\f');
        return;
      case 'n':
        out.push_back('\n');
        return;
      case 'r':
        out.push_back('\r');
        return;
      case 't':
        out.push_back('\t');
        return;
      case 'u':
        append_utf8(out, code_point());
        return;
      default:
        fail("unknown escape in a string");
    }
  }

  std::uint32_t code_point() {
    const std::uint32_t unit = hex4();
    if (unit < 0xD800 || unit > 0xDFFF) {
      return unit;
    }
    if (unit > 0xDBFF || next() != '\\' || next() != 'u') {
      fail("lone surrogate in a string");
    }
    const std::uint32_t low = hex4();
    if (low < 0xDC00 || low > 0xDFFF) {
      fail("lone surrogate in a string");
    }
    return 0x10000 + ((unit - 0xD800) << 10) + (low - 0xDC00);
  }

  static void append_utf8(std::string& out, std::uint32_t code) {
    const auto tail = [&](int shift) { out.push_back(static_cast<char>(0x80 | ((code >> shift) & 0x3F))); };
    if (code < 0x80) {
      out.push_back(static_cast<char>(code));
    } else if (code < 0x800) {
      out.push_back(static_cast<char>(0xC0 | (code >> 6)));
      tail(0);
    } else if (code < 0x10000) {
      out.push_back(static_cast<char>(0xE0 | (code >> 12)));
      tail(6);
      tail(0);
    } else {
      out.push_back(static_cast<char>(0xF0 | (code >> 18)));
      tail(12);
      tail(6);
      tail(0);
    }
  }

  std::string_view text_;
  std::size_t position_ = 0;
};

/// Run `member(key)` for each member of an object; the key and its colon are consumed.
template <typename Member>
void parse_object(Cursor& cursor, const Member& member) {
  cursor.expect('{');
  if (cursor.accept('}')) {
    return;
  }
  do {
    std::string key = cursor.string();
    cursor.expect(':');
    member(std::move(key));
  } while (cursor.accept(','));
  cursor.expect('}');
}

std::map<std::string, std::string> parse_strings(Cursor& cursor) {
  std::map<std::string, std::string> strings;
  parse_object(cursor, [&](std::string key) {
    std::string value = cursor.string();
    if (!strings.emplace(std::move(key), std::move(value)).second) {
      cursor.fail("duplicate key in the metadata");
    }
  });
  return strings;
}

void finish(Cursor& cursor) {
  cursor.skip_space();
  if (!cursor.at_end()) {
    cursor.fail("text after the end of the header");
  }
}

std::vector<std::int64_t> parse_integers(Cursor& cursor, std::size_t limit) {
  std::vector<std::int64_t> values;
  cursor.expect('[');
  if (cursor.accept(']')) {
    return values;
  }
  do {
    if (values.size() == limit) {
      cursor.fail("more than " + std::to_string(limit) + " numbers in a list");
    }
    values.push_back(cursor.integer());
  } while (cursor.accept(','));
  cursor.expect(']');
  return values;
}

TensorEntry parse_entry(Cursor& cursor) {
  TensorEntry entry;
  bool has_dtype = false, has_shape = false, has_offsets = false;
  const auto once = [&](bool& seen) {
    if (seen) {
      cursor.fail("duplicate field of a tensor");
    }
    seen = true;
  };
  parse_object(cursor, [&](const std::string& key) {
    if (key == "dtype") {
      once(has_dtype);
      entry.dtype = cursor.string();
    } else if (key == "shape") {
      once(has_shape);
      entry.shape = parse_integers(cursor, kMaxSides);
    } else if (key == "data_offsets") {
      once(has_offsets);
      const auto offsets = parse_integers(cursor, 2);
      if (offsets.size() != 2) {
        cursor.fail("data_offsets needs two numbers");
      }
      entry.begin = static_cast<std::uint64_t>(offsets[0]);
      entry.end = static_cast<std::uint64_t>(offsets[1]);
    } else {
      cursor.fail("unknown field of a tensor");
    }
  });
  if (!has_dtype || !has_shape || !has_offsets) {
    cursor.fail("tensor without dtype, shape or data_offsets");
  }
  return entry;
}

void append_quoted(std::string& out, const std::string& text) {
  out.push_back('"');
  for (const char c : text) {
    if (c == '"' || c == '\\') {
      out.push_back('\\');
      out.push_back(c);
    } else if (static_cast<unsigned char>(c) < 0x20) {
      char escape[8];
      std::snprintf(escape, sizeof escape, "\\u%04x", static_cast<unsigned>(static_cast<unsigned char>(c)));
      out += escape;
    } else {
      out.push_back(c);
    }
  }
  out.push_back('"');
}

}  // namespace

SafetensorsHeader parse_safetensors_header(std::string_view text) {
  SafetensorsHeader header;
  Cursor cursor(text);
  bool has_metadata = false;
  parse_object(cursor, [&](std::string key) {
    if (key == "__metadata__") {
      if (has_metadata) {
        cursor.fail("duplicate key '__metadata__'");
      }
      has_metadata = true;
      header.metadata = parse_strings(cursor);
    } else {
      TensorEntry entry = parse_entry(cursor);
      if (!header.tensors.emplace(std::move(key), std::move(entry)).second) {
        cursor.fail("duplicate tensor name");
      }
    }
  });
  finish(cursor);
  return header;
}

std::map<std::string, std::string> parse_string_map(std::string_view text) {
  Cursor cursor(text);
  auto strings = parse_strings(cursor);
  finish(cursor);
  return strings;
}

std::string format_string_map(const std::map<std::string, std::string>& strings) {
  std::string text = "{";
  const char* separator = "";
  for (const auto& [key, value] : strings) {
    text += separator;
    append_quoted(text, key);
    text += ':';
    append_quoted(text, value);
    separator = ",";
  }
  text += '}';
  return text;
}

std::string format_safetensors_header(const SafetensorsHeader& header) {
  std::string text = "{";
  const char* separator = "";
  if (!header.metadata.empty()) {
    text += "\"__metadata__\":";
    text += format_string_map(header.metadata);
    separator = ",";
  }
  for (const auto& [name, entry] : header.tensors) {
    text += separator;
    append_quoted(text, name);
    text += ":{\"dtype\":";
    append_quoted(text, entry.dtype);
    text += ",\"shape\":[";
    for (std::size_t i = 0; i < entry.shape.size(); ++i) {
      text += i == 0 ? "" : ",";
      text += std::to_string(entry.shape[i]);
    }
    text += "],\"data_offsets\":[" + std::to_string(entry.begin) + "," + std::to_string(entry.end) + "]}";
    separator = ",";
  }
  return text + "}";
}

}  // namespace ajna::nn
