// SPDX-License-Identifier: MIT
#include "ajna/io/pfm_io.hpp"

#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <locale>
#include <sstream>
#include <string>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/io/image_header.hpp"

namespace ajna::io {
namespace {

bool is_space(char c) { return c == ' ' || (c >= '\t' && c <= '\r'); }

/// The next white-space delimited word of the header, at most 32 characters, with exactly one separator consumed.
std::string word(const Bytes& bytes, std::size_t& position, const std::string& name) {
  std::string text;
  while (position < bytes.size() && text.size() <= 32) {
    const char c = static_cast<char>(bytes[position++]);
    if (!is_space(c)) {
      text += c;
    } else if (!text.empty()) {
      return text;
    }
  }
  throw_invalid("PFM file '" + name + "' has a truncated or damaged header: get a good copy");
}

int side(const std::string& text, const std::string& name) {
  int value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc{} || end != text.data() + text.size()) {
    throw_invalid("PFM file '" + name + "' has the size '" + text + "': get a good copy");
  }
  return value;
}

/// Not strtod: it follows the process's locale, in which the decimal point may be a comma.
double scale_of(const std::string& text, const std::string& name) {
  std::istringstream stream(text);
  stream.imbue(std::locale::classic());
  double scale = 0;
  stream >> scale;
  if (stream.fail() || !stream.eof() || !std::isfinite(scale) || scale == 0) {
    throw_invalid("PFM file '" + name + "' has the scale '" + text +
                  "': a non-zero number whose sign tells the byte order is expected");
  }
  return scale;
}

}  // namespace

FloatImage read_pfm(const std::filesystem::path& path) {
  const std::string name = path.string();
  const Bytes bytes = read_file(path, 12 * static_cast<std::size_t>(kMaxPixels) + 256);
  if (bytes.size() < 3 || bytes[0] != 'P' || (bytes[1] != 'f' && bytes[1] != 'F') ||
      !is_space(static_cast<char>(bytes[2]))) {
    throw_invalid("file '" + name + "' is not a PFM file (it does not begin with Pf or PF): give a portable float map");
  }
  FloatImage image;
  image.channels = bytes[1] == 'F' ? 3 : 1;
  std::size_t position = 3;
  image.width = side(word(bytes, position, name), name);
  image.height = side(word(bytes, position, name), name);
  check_image_size(image.width, image.height, name);
  const bool little = scale_of(word(bytes, position, name), name) < 0;
  const std::size_t row = static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.channels);
  const std::size_t values = row * static_cast<std::size_t>(image.height);
  if (const std::size_t expected = position + 4 * values; bytes.size() != expected) {
    throw_invalid("PFM file '" + name + "' is " + (bytes.size() < expected ? "truncated" : "too long") + " (" +
                  std::to_string(bytes.size()) + " bytes, " + std::to_string(expected) + " expected for " +
                  std::to_string(image.width) + "x" + std::to_string(image.height) + "): get a good copy");
  }
  image.data.resize(values);
  for (std::size_t i = 0; i < values; ++i) {
    const std::uint8_t* p = bytes.data() + position + 4 * i;
    std::uint32_t bits = 0;
    for (int k = 0; k < 4; ++k) {
      bits |= std::uint32_t{p[k]} << (8 * (little ? k : 3 - k));
    }
    const std::size_t y = static_cast<std::size_t>(image.height) - 1 - i / row;
    std::memcpy(&image.data[y * row + i % row], &bits, sizeof bits);
  }
  return image;
}

void write_pfm(const std::filesystem::path& path, const float* data, int width, int height, int channels) {
  const std::string name = path.string();
  if (data == nullptr || channels < 1 || channels > 3) {
    throw_invalid("PFM image for '" + name + "' has " + std::to_string(channels) + " channels: 1 to 3 can be stored");
  }
  check_image_size(width, height, name);
  const int stored = channels == 1 ? 1 : 3;
  const std::string header =
      std::string(stored == 1 ? "Pf" : "PF") + "\n" + std::to_string(width) + " " + std::to_string(height) + "\n-1.0\n";
  Bytes bytes(header.begin(), header.end());
  bytes.reserve(bytes.size() + 4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height) *
                                   static_cast<std::size_t>(stored));
  for (int y = height - 1; y >= 0; --y) {
    for (int x = 0; x < width; ++x) {
      for (int c = 0; c < stored; ++c) {
        std::uint32_t bits = 0;
        if (c < channels) {
          const std::size_t pixel =
              static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
          std::memcpy(&bits, data + pixel * static_cast<std::size_t>(channels) + static_cast<std::size_t>(c), 4);
        }
        for (int k = 0; k < 4; ++k) {
          bytes.push_back(static_cast<std::uint8_t>(bits >> (8 * k)));
        }
      }
    }
  }
  write_file_atomically(path, bytes.data(), bytes.size());
}

}  // namespace ajna::io
