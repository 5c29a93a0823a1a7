// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iterator>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"

/// Helpers of the io tests: a folder of their own, and writers that share no code with the library.
namespace ajna::io::testing {

namespace fs = std::filesystem;
using Bytes = std::vector<std::uint8_t>;

class TempFolder {
 public:
  TempFolder() {
    const auto* info = ::testing::UnitTest::GetInstance()->current_test_info();
    path_ = fs::temp_directory_path() / ("ajna-io-" + std::to_string(::getpid()) + "-" + info->name());
    fs::remove_all(path_);
    fs::create_directories(path_);
  }
  ~TempFolder() {
    std::error_code ignored;
    fs::remove_all(path_, ignored);
  }
  TempFolder(const TempFolder&) = delete;
  TempFolder& operator=(const TempFolder&) = delete;
  [[nodiscard]] fs::path operator/(const std::string& name) const { return path_ / name; }
  [[nodiscard]] const fs::path& path() const { return path_; }
  [[nodiscard]] std::size_t entries() const {
    return static_cast<std::size_t>(std::distance(fs::directory_iterator(path_), fs::directory_iterator()));
  }

 private:
  fs::path path_;
};

inline void put(const fs::path& path, const Bytes& bytes) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
}
inline void put(const fs::path& path, const std::string& text) { put(path, Bytes(text.begin(), text.end())); }

inline Bytes get(const fs::path& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), std::istreambuf_iterator<char>()};
}

/// The kind and message of the ajna::Error that `action` throws; fails the test where it throws nothing.
inline Error error_of(const std::function<void()>& action) {
  try {
    action();
  } catch (const Error& error) {
    return error;
  }
  ADD_FAILURE() << "no ajna::Error was thrown";
  return {ErrorKind::kRuntime, ""};
}

#define AJNA_EXPECT_ERROR(action, expected_kind, fragment)                                           \
  do {                                                                                               \
    const ::ajna::Error caught = ::ajna::io::testing::error_of([&] { (void)(action); });             \
    EXPECT_EQ(caught.kind(), expected_kind) << caught.what();                                        \
    EXPECT_NE(std::string(caught.what()).find(fragment), std::string::npos) << caught.what();        \
    EXPECT_EQ(std::string(caught.what()).find('\n'), std::string::npos) << "more than one sentence"; \
  } while (false)

inline void append_big32(Bytes& bytes, std::uint32_t value) {
  for (int shift = 24; shift >= 0; shift -= 8) {
    bytes.push_back(static_cast<std::uint8_t>(value >> shift));
  }
}

inline std::uint32_t crc_of(const std::uint8_t* data, std::size_t size) {
  std::uint32_t crc = ~0U;
  for (std::size_t i = 0; i < size; ++i) {
    crc ^= data[i];
    for (int bit = 0; bit < 8; ++bit) {
      crc = (crc >> 1) ^ (0xEDB88320U & (0U - (crc & 1U)));
    }
  }
  return ~crc;
}

inline void append_chunk(Bytes& png, const std::string& type, const Bytes& data) {
  append_big32(png, static_cast<std::uint32_t>(data.size()));
  const std::size_t begin = png.size();
  png.insert(png.end(), type.begin(), type.end());
  png.insert(png.end(), data.begin(), data.end());
  append_big32(png, crc_of(png.data() + begin, png.size() - begin));
}

/// A PNG with one stored (uncompressed) deflate block; `rows` are the bytes of each row without the filter byte.
/// colour_type: 0 grey, 2 RGB, 4 grey + alpha, 6 RGBA.
inline Bytes make_png(std::uint32_t width, std::uint32_t height, int depth, int colour_type,
                      const std::vector<Bytes>& rows) {
  Bytes raw;
  for (const Bytes& row : rows) {
    raw.push_back(0);
    raw.insert(raw.end(), row.begin(), row.end());
  }
  std::uint32_t a = 1;
  std::uint32_t b = 0;
  for (const std::uint8_t byte : raw) {
    a = (a + byte) % 65521;
    b = (b + a) % 65521;
  }
  const auto size = static_cast<std::uint16_t>(raw.size());
  Bytes zlib = {0x78, 0x01, 0x01};
  for (const std::uint16_t half : {size, static_cast<std::uint16_t>(~size)}) {
    zlib.push_back(static_cast<std::uint8_t>(half & 0xFF));
    zlib.push_back(static_cast<std::uint8_t>(half >> 8));
  }
  zlib.insert(zlib.end(), raw.begin(), raw.end());
  append_big32(zlib, (b << 16) | a);
  Bytes png = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1A, '\n'};
  Bytes header;
  append_big32(header, width);
  append_big32(header, height);
  header.insert(header.end(), {static_cast<std::uint8_t>(depth), static_cast<std::uint8_t>(colour_type), 0, 0, 0});
  append_chunk(png, "IHDR", header);
  append_chunk(png, "IDAT", zlib);
  append_chunk(png, "IEND", {});
  return png;
}

}  // namespace ajna::io::testing
