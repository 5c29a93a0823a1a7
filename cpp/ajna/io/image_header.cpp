// SPDX-License-Identifier: MIT
#include "ajna/io/image_header.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <string_view>

#include "ajna/base/error.hpp"
#include "ajna/io/pnm.hpp"

namespace ajna::io {
namespace {

std::uint32_t big32(const std::uint8_t* p) {
  return (std::uint32_t{p[0]} << 24) | (std::uint32_t{p[1]} << 16) | (std::uint32_t{p[2]} << 8) | p[3];
}
std::uint32_t big16(const std::uint8_t* p) { return (std::uint32_t{p[0]} << 8) | p[1]; }
std::uint32_t little32(const std::uint8_t* p) {
  return (std::uint32_t{p[3]} << 24) | (std::uint32_t{p[2]} << 16) | (std::uint32_t{p[1]} << 8) | p[0];
}
std::uint32_t little16(const std::uint8_t* p) { return (std::uint32_t{p[1]} << 8) | p[0]; }

bool starts_with(const Bytes& bytes, std::string_view magic) {
  return bytes.size() >= magic.size() && std::memcmp(bytes.data(), magic.data(), magic.size()) == 0;
}

[[noreturn]] void throw_truncated(const std::string& name) {
  throw_invalid("image '" + name + "' is truncated: get a complete copy");
}
[[noreturn]] void throw_damaged(const std::string& name, const std::string& what) {
  throw_invalid("image '" + name + "' is damaged (" + what + "): get a good copy");
}

/// CRC-32 as PNG uses it (ISO 3309).
std::uint32_t crc32(const std::uint8_t* data, std::size_t size) {
  static const auto table = [] {
    std::array<std::uint32_t, 256> entries{};
    for (std::uint32_t n = 0; n < 256; ++n) {
      std::uint32_t c = n;
      for (int bit = 0; bit < 8; ++bit) {
        c = (c & 1U) != 0 ? 0xEDB88320U ^ (c >> 1) : c >> 1;
      }
      entries[n] = c;
    }
    return entries;
  }();
  std::uint32_t crc = 0xFFFFFFFFU;
  for (std::size_t i = 0; i < size; ++i) {
    crc = table[(crc ^ data[i]) & 0xFFU] ^ (crc >> 8);
  }
  return crc ^ 0xFFFFFFFFU;
}

constexpr std::string_view kPngMagic = "\x89PNG\r\n\x1a\n";

ImageHeader check_png(const Bytes& bytes, const std::string& name) {
  ImageHeader header;
  bool has_pixels = false;
  std::size_t position = kPngMagic.size();
  while (true) {
    if (bytes.size() - position < 12) {
      throw_truncated(name);
    }
    const std::uint8_t* chunk = bytes.data() + position;
    const std::size_t length = big32(chunk);
    if (length > bytes.size() - position - 12) {
      throw_truncated(name);
    }
    const std::string_view type(reinterpret_cast<const char*>(chunk + 4), 4);
    if (crc32(chunk + 4, length + 4) != big32(chunk + 8 + length)) {
      throw_damaged(name, "a PNG chunk fails its checksum");
    }
    const bool first = position == kPngMagic.size();
    if (first != (type == "IHDR") || (first && length != 13)) {
      throw_damaged(name, "its PNG header is not in its place");
    }
    if (first) {
      const std::uint8_t* data = chunk + 8;
      check_image_size(big32(data), big32(data + 4), name);
      header.format = ImageFormat::kPng;
      header.width = static_cast<int>(big32(data));
      header.height = static_cast<int>(big32(data + 4));
      header.bit_depth = data[8];
      constexpr std::array<int, 7> kChannels = {1, 0, 3, 1, 2, 0, 4};
      header.channels = data[9] < kChannels.size() ? kChannels[data[9]] : 0;
      if (header.channels == 0) {
        throw_damaged(name, "its PNG colour type is unknown");
      }
    }
    has_pixels = has_pixels || type == "IDAT";
    position += length + 12;
    if (type == "IEND") {
      break;
    }
  }
  if (!has_pixels) {
    throw_damaged(name, "it holds no pixels");
  }
  return header;
}

bool is_frame_marker(std::uint8_t marker) {
  return marker >= 0xC0 && marker <= 0xCF && marker != 0xC4 && marker != 0xC8 && marker != 0xCC;
}

/// One past the entropy-coded data that begins at `position`: the next marker that is neither stuffing nor a restart.
std::size_t skip_scan(const Bytes& bytes, std::size_t position) {
  while (position + 1 < bytes.size()) {
    const std::uint8_t next = bytes[position + 1];
    if (bytes[position] == 0xFF && next != 0x00 && next != 0xFF && !(next >= 0xD0 && next <= 0xD7)) {
      return position;
    }
    ++position;
  }
  return bytes.size();
}

ImageHeader check_jpeg(const Bytes& bytes, const std::string& name) {
  ImageHeader header;
  header.format = ImageFormat::kJpeg;
  bool has_pixels = false;
  std::size_t position = 2;
  while (true) {
    while (position + 1 < bytes.size() && bytes[position] == 0xFF && bytes[position + 1] == 0xFF) {
      ++position;  // fill bytes
    }
    if (position + 2 > bytes.size()) {
      throw_truncated(name);
    }
    if (bytes[position] != 0xFF) {
      throw_damaged(name, "a JPEG marker is missing");
    }
    const std::uint8_t marker = bytes[position + 1];
    position += 2;
    if (marker == 0xD9) {
      break;
    }
    if (position + 2 > bytes.size()) {
      throw_truncated(name);
    }
    const std::size_t length = big16(bytes.data() + position);
    if (length < 2) {
      throw_damaged(name, "a JPEG segment has no length");
    }
    if (length > bytes.size() - position) {
      throw_truncated(name);
    }
    if (is_frame_marker(marker)) {
      if (length < 8) {
        throw_damaged(name, "its JPEG frame header is short");
      }
      const std::uint8_t* data = bytes.data() + position + 2;
      check_image_size(big16(data + 3), big16(data + 1), name);
      if (data[0] != 8) {
        throw_invalid("image '" + name + "' is a JPEG of " + std::to_string(data[0]) +
                      " bits a sample: save it as PNG or as an 8-bit JPEG");
      }
      header.width = static_cast<int>(big16(data + 3));
      header.height = static_cast<int>(big16(data + 1));
      header.channels = data[5];
    }
    position += length;
    if (marker == 0xDA) {
      if (header.width == 0) {
        throw_damaged(name, "its JPEG frame header is missing");
      }
      has_pixels = true;
      position = skip_scan(bytes, position);
    }
  }
  if (!has_pixels) {
    throw_damaged(name, "it holds no pixels");
  }
  return header;
}

ImageHeader check_bmp(const Bytes& bytes, const std::string& name) {
  if (bytes.size() < 54) {
    throw_truncated(name);
  }
  const std::uint8_t* p = bytes.data();
  const std::size_t offset = little32(p + 10);
  if (little32(p + 14) < 40) {
    throw_invalid("image '" + name + "' is an OS/2 BMP: save it as PNG");
  }
  const auto width = static_cast<std::int32_t>(little32(p + 18));
  const auto height = static_cast<std::int32_t>(little32(p + 22));  // negative: rows run top down
  check_image_size(width, std::llabs(height), name);
  const std::uint32_t depth = little16(p + 28);
  const std::uint32_t compression = little32(p + 30);
  if (compression != 0 && compression != 3) {
    throw_invalid("image '" + name + "' is a compressed BMP: save it as PNG");
  }
  if (depth != 1 && depth != 4 && depth != 8 && depth != 16 && depth != 24 && depth != 32) {
    throw_damaged(name, "its BMP header claims " + std::to_string(depth) + " bits per pixel");
  }
  const std::size_t row = (static_cast<std::size_t>(width) * depth + 31) / 32 * 4;
  if (offset < 54 || offset > bytes.size() ||
      bytes.size() - offset < row * static_cast<std::size_t>(std::llabs(height))) {
    throw_truncated(name);
  }
  return {ImageFormat::kBmp, width, static_cast<int>(std::llabs(height)), 8, depth == 32 ? 4 : depth == 24 ? 3 : 1};
}

ImageHeader check_pnm(const Bytes& bytes, const std::string& name) {
  const PnmHeader header = parse_pnm_header(bytes, name);
  return {ImageFormat::kPnm, header.width, header.height, header.max_value > 255 ? 16 : 8, header.channels};
}

/// Whether the first bytes read as text, for a clearer message.
bool looks_like_text(const Bytes& bytes) {
  const std::size_t size = std::min<std::size_t>(bytes.size(), 512);
  return std::all_of(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(size),
                     [](std::uint8_t c) { return (c >= 32 && c < 127) || (c >= '\t' && c <= '\r'); });
}

}  // namespace

void check_image_size(long long width, long long height, const std::string& name) {
  if (width <= 0 || height <= 0) {
    throw_invalid("image '" + name + "' has size " + std::to_string(width) + "x" + std::to_string(height) +
                  ": both sides must be positive");
  }
  if (width > kMaxPixels || height > kMaxPixels || width * height > kMaxPixels) {
    throw_invalid("image '" + name + "' claims " + std::to_string(width) + "x" + std::to_string(height) +
                  " pixels: at most " + std::to_string(kMaxPixels) + " are read");
  }
}

ImageHeader check_image_file(const Bytes& bytes, const std::string& name) {
  if (starts_with(bytes, kPngMagic)) {
    return check_png(bytes, name);
  }
  if (starts_with(bytes, "\xFF\xD8\xFF")) {
    return check_jpeg(bytes, name);
  }
  if (starts_with(bytes, "BM")) {
    return check_bmp(bytes, name);
  }
  for (const char* magic : {"P2", "P3", "P5", "P6"}) {
    if (starts_with(bytes, magic)) {
      return check_pnm(bytes, name);
    }
  }
  // A prefix of a magic number is what a truncated download leaves.
  if (bytes.size() < kPngMagic.size() && std::memcmp(bytes.data(), kPngMagic.data(), bytes.size()) == 0) {
    throw_truncated(name);
  }
  throw_invalid("file '" + name + "' is not an image" + (looks_like_text(bytes) ? " but text" : "") +
                ": PNG, JPEG, BMP, PPM and PGM are read");
}

}  // namespace ajna::io
