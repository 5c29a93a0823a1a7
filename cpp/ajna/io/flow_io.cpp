// SPDX-License-Identifier: MIT
#include "ajna/io/flow_io.hpp"

#include <cmath>
#include <cstring>
#include <opencv2/imgcodecs.hpp>
#include <string>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/io/image_header.hpp"

namespace ajna::io {
namespace {

constexpr float kFloMagic = 202021.25F;  // reads "PIEH" in a little-endian file
constexpr std::size_t kFloHeader = 12;
constexpr float kKittiScale = 64.0F;
constexpr float kKittiOffset = 32768.0F;

std::uint32_t load_little(const std::uint8_t* p) {
  return (std::uint32_t{p[3]} << 24) | (std::uint32_t{p[2]} << 16) | (std::uint32_t{p[1]} << 8) | p[0];
}

float to_float(std::uint32_t bits) {
  float value = 0;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

void store_little(std::uint32_t value, std::uint8_t* p) {
  for (int i = 0; i < 4; ++i) {
    p[i] = static_cast<std::uint8_t>(value >> (8 * i));
  }
}

void store_little(float value, std::uint8_t* p) {
  std::uint32_t bits = 0;
  std::memcpy(&bits, &value, sizeof bits);
  store_little(bits, p);
}

bool is_known(float component) { return std::abs(component) <= kUnknownFlowThreshold; }  // false for NaN

std::size_t checked_pixels(const FlowView& flow, const std::string& name) {
  if (flow.flow == nullptr || flow.width <= 0 || flow.height <= 0) {
    throw_invalid("flow for '" + name + "' has size " + std::to_string(flow.width) + "x" + std::to_string(flow.height) +
                  ": both sides must be positive");
  }
  check_image_size(flow.width, flow.height, name);
  return static_cast<std::size_t>(flow.width) * static_cast<std::size_t>(flow.height);
}

[[noreturn]] void throw_bad_value(const FlowView& flow, std::size_t pixel, const std::string& name,
                                  const std::string& remedy) {
  const std::size_t x = pixel % static_cast<std::size_t>(flow.width);
  const std::size_t y = pixel / static_cast<std::size_t>(flow.width);
  throw_invalid("flow for '" + name + "' is (" + std::to_string(flow.flow[2 * pixel]) + ", " +
                std::to_string(flow.flow[2 * pixel + 1]) + ") at x " + std::to_string(x) + ", y " + std::to_string(y) +
                ": " + remedy);
}

}  // namespace

std::vector<std::uint8_t> known_flow(const float* flow, std::size_t pixels) {
  std::vector<std::uint8_t> known(pixels);
  for (std::size_t i = 0; i < pixels; ++i) {
    known[i] = is_known(flow[2 * i]) && is_known(flow[2 * i + 1]) ? 1 : 0;
  }
  return known;
}

FlowImage read_flo(const std::filesystem::path& path) {
  const std::string name = path.string();
  const Bytes bytes = read_file(path, kFloHeader + 8 * static_cast<std::size_t>(kMaxPixels));
  if (bytes.size() >= 4 && to_float(load_little(bytes.data())) != kFloMagic) {
    throw_invalid("file '" + name + "' is not a .flo file (it does not begin with PIEH): give a Middlebury flow file");
  }
  if (bytes.size() < kFloHeader) {
    throw_invalid("flow file '" + name + "' is truncated (" + std::to_string(bytes.size()) +
                  " bytes): get a complete copy");
  }
  const auto width = static_cast<std::int32_t>(load_little(bytes.data() + 4));
  const auto height = static_cast<std::int32_t>(load_little(bytes.data() + 8));
  check_image_size(width, height, name);
  const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  if (const std::size_t expected = kFloHeader + 8 * pixels; bytes.size() != expected) {
    throw_invalid("flow file '" + name + "' is " + (bytes.size() < expected ? "truncated" : "too long") + " (" +
                  std::to_string(bytes.size()) + " bytes, " + std::to_string(expected) + " expected for " +
                  std::to_string(width) + "x" + std::to_string(height) + "): get a good copy");
  }
  FlowImage image{width, height, std::vector<float>(2 * pixels), {}};
  for (std::size_t i = 0; i < image.flow.size(); ++i) {
    image.flow[i] = to_float(load_little(bytes.data() + kFloHeader + 4 * i));
  }
  image.valid = known_flow(image.flow.data(), pixels);
  return image;
}

void write_flo(const std::filesystem::path& path, const FlowView& flow) {
  const std::string name = path.string();
  const std::size_t pixels = checked_pixels(flow, name);
  Bytes bytes(kFloHeader + 8 * pixels);
  store_little(kFloMagic, bytes.data());
  store_little(static_cast<std::uint32_t>(flow.width), bytes.data() + 4);
  store_little(static_cast<std::uint32_t>(flow.height), bytes.data() + 8);
  for (std::size_t i = 0; i < pixels; ++i) {
    const bool valid = flow.valid == nullptr || flow.valid[i] != 0;
    if (valid && !(is_known(flow.flow[2 * i]) && is_known(flow.flow[2 * i + 1]))) {
      throw_bad_value(flow, i, name, "mark unknown pixels as invalid");
    }
    for (std::size_t c = 0; c < 2; ++c) {
      store_little(valid ? flow.flow[2 * i + c] : kUnknownFlow, bytes.data() + kFloHeader + 4 * (2 * i + c));
    }
  }
  write_file_atomically(path, bytes.data(), bytes.size());
}

FlowImage read_kitti_flow(const std::filesystem::path& path) {
  const std::string name = path.string();
  const Bytes bytes = read_file(path, std::size_t{1} << 30);
  const ImageHeader header = check_image_file(bytes, name);
  if (header.format != ImageFormat::kPng || header.bit_depth != 16 || header.channels != 3) {
    throw_invalid("image '" + name + "' is not KITTI flow (" + std::to_string(header.channels) + " channels of " +
                  std::to_string(header.bit_depth) + " bits): give a 16-bit RGB PNG");
  }
  cv::Mat bgr;
  try {
    bgr = cv::imdecode(bytes, cv::IMREAD_UNCHANGED);
  } catch (const cv::Exception&) {
    bgr.release();
  }
  if (bgr.empty() || bgr.type() != CV_16UC3 || bgr.cols != header.width || bgr.rows != header.height) {
    throw_invalid("image '" + name + "' is damaged (its pixels cannot be decoded): get a good copy");
  }
  const std::size_t pixels = bgr.total();
  FlowImage image{bgr.cols, bgr.rows, std::vector<float>(2 * pixels), std::vector<std::uint8_t>(pixels)};
  std::size_t i = 0;
  for (int y = 0; y < bgr.rows; ++y) {
    const auto* row = bgr.ptr<cv::Vec3w>(y);
    for (int x = 0; x < bgr.cols; ++x, ++i) {
      if (row[x][0] != 0) {  // OpenCV hands out B, G, R
        image.valid[i] = 1;
        image.flow[2 * i] = (static_cast<float>(row[x][2]) - kKittiOffset) / kKittiScale;
        image.flow[2 * i + 1] = (static_cast<float>(row[x][1]) - kKittiOffset) / kKittiScale;
      }
    }
  }
  return image;
}

void write_kitti_flow(const std::filesystem::path& path, const FlowView& flow) {
  const std::string name = path.string();
  checked_pixels(flow, name);
  if (path.extension() != ".png") {
    throw_invalid("KITTI flow file '" + name + "' has the extension '" + path.extension().string() + "': use .png");
  }
  cv::Mat bgr(flow.height, flow.width, CV_16UC3, cv::Scalar(0, 0, 0));
  std::size_t i = 0;
  for (int y = 0; y < flow.height; ++y) {
    auto* row = bgr.ptr<cv::Vec3w>(y);
    for (int x = 0; x < flow.width; ++x, ++i) {
      if (flow.valid != nullptr && flow.valid[i] == 0) {
        continue;
      }
      const float red = std::round(flow.flow[2 * i] * kKittiScale) + kKittiOffset;
      const float green = std::round(flow.flow[2 * i + 1] * kKittiScale) + kKittiOffset;
      if (!(red >= 0 && red <= 65535 && green >= 0 && green <= 65535)) {  // catches NaN too
        throw_bad_value(flow, i, name, "KITTI flow holds -512 to 511.98 pixels; mark the pixel as invalid or use .flo");
      }
      row[x] = cv::Vec3w(1, static_cast<std::uint16_t>(green), static_cast<std::uint16_t>(red));
    }
  }
  Bytes bytes;
  bool encoded = false;
  try {
    encoded = cv::imencode(".png", bgr, bytes);
  } catch (const cv::Exception&) {
    encoded = false;
  }
  if (!encoded) {
    throw_runtime("KITTI flow '" + name + "' cannot be encoded as PNG: check OpenCV's installation");
  }
  write_file_atomically(path, bytes.data(), bytes.size());
}

}  // namespace ajna::io
