// SPDX-License-Identifier: MIT
#include "ajna/io/pnm.hpp"

#include <cstdint>

#include "ajna/base/error.hpp"

namespace ajna::io {
namespace {

bool is_space(std::uint8_t c) { return c == ' ' || (c >= '\t' && c <= '\r'); }
bool is_digit(std::uint8_t c) { return c >= '0' && c <= '9'; }

/// Reads the text part: decimal numbers apart by white space and comments.
class Scanner {
 public:
  Scanner(const Bytes& bytes, std::size_t position, const std::string& name)
      : bytes_(bytes), position_(position), name_(name) {}

  long long number(const char* what) {
    while (position_ < bytes_.size() && (is_space(bytes_[position_]) || bytes_[position_] == '#')) {
      if (bytes_[position_] == '#') {
        while (position_ < bytes_.size() && bytes_[position_] != '\n') {
          ++position_;
        }
      } else {
        ++position_;
      }
    }
    if (position_ == bytes_.size()) {
      throw_invalid("image '" + name_ + "' is truncated (no " + what + "): get a complete copy");
    }
    long long value = 0;
    const std::size_t begin = position_;
    for (; position_ < bytes_.size() && is_digit(bytes_[position_]); ++position_) {
      value = value * 10 + (bytes_[position_] - '0');
      if (value > 1'000'000'000) {
        throw_invalid("image '" + name_ + "' has an absurd " + what + ": get a good copy");
      }
    }
    if (position_ == begin) {
      throw_invalid("image '" + name_ + "' is damaged (its " + what + " is not a number): get a good copy");
    }
    return value;
  }

  [[nodiscard]] std::size_t position() const noexcept { return position_; }

 private:
  const Bytes& bytes_;
  std::size_t position_;
  const std::string& name_;
};

}  // namespace

PnmHeader parse_pnm_header(const Bytes& bytes, const std::string& name) {
  PnmHeader header;
  const char kind = bytes.size() > 1 ? static_cast<char>(bytes[1]) : '?';
  header.ascii = kind == '2' || kind == '3';
  header.channels = kind == '2' || kind == '5' ? 1 : 3;
  Scanner scanner(bytes, 2, name);
  const long long width = scanner.number("width");
  const long long height = scanner.number("height");
  const long long max_value = scanner.number("largest value");
  check_image_size(width, height, name);
  if (max_value < 1 || max_value > 65535) {
    throw_invalid("image '" + name + "' has a largest value of " + std::to_string(max_value) +
                  ": 1 to 65535 are allowed");
  }
  header.width = static_cast<int>(width);
  header.height = static_cast<int>(height);
  header.max_value = static_cast<int>(max_value);
  header.data_offset = scanner.position() + 1;  // exactly one white space ends the header
  const std::size_t samples = static_cast<std::size_t>(width * height) * static_cast<std::size_t>(header.channels);
  // In text, n samples need at least n digits and n - 1 separators.
  const std::size_t needed = header.ascii ? 2 * samples - 1 : samples * (max_value > 255 ? 2 : 1);
  if (header.data_offset > bytes.size() || bytes.size() - header.data_offset < needed) {
    throw_invalid("image '" + name + "' is truncated (" + std::to_string(bytes.size()) + " bytes, at least " +
                  std::to_string(header.data_offset + needed) + " expected): get a complete copy");
  }
  return header;
}

Image decode_pnm(const Bytes& bytes, const std::string& name) {
  const PnmHeader header = parse_pnm_header(bytes, name);
  Image image(header.width, header.height);
  Scanner scanner(bytes, header.data_offset, name);
  std::size_t position = header.data_offset;
  const auto next = [&]() -> long long {
    if (header.ascii) {
      return scanner.number("sample");
    }
    if (header.max_value > 255) {
      const long long value = bytes[position] * 256LL + bytes[position + 1];
      position += 2;
      return value;
    }
    return bytes[position++];
  };
  const auto sample = [&] {
    const long long value = next();
    if (value > header.max_value) {
      throw_invalid("image '" + name + "' holds a sample of " + std::to_string(value) + " above its largest value of " +
                    std::to_string(header.max_value) + ": get a good copy");
    }
    return static_cast<std::uint8_t>((value * 255 + header.max_value / 2) / header.max_value);
  };
  std::uint8_t* out = image.data();
  for (std::size_t i = 0; i < image.size_bytes(); i += 3) {
    out[i] = sample();
    out[i + 1] = header.channels == 3 ? sample() : out[i];
    out[i + 2] = header.channels == 3 ? sample() : out[i];
  }
  return image;
}

}  // namespace ajna::io
