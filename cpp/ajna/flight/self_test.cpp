// SPDX-License-Identifier: MIT
#include "ajna/flight/self_test.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/flight/source.hpp"

namespace ajna::flight {
namespace {

/// Noise at a grid point, 0 to 1: an integer hash.
double lattice(int x, int y, int seed) {
  auto h = static_cast<std::uint32_t>(x) * 0x8da6b343U ^ static_cast<std::uint32_t>(y) * 0xd8163841U ^
           static_cast<std::uint32_t>(seed) * 0xcb1ab31fU;
  h = (h ^ (h >> 13)) * 0x5bd1e995U;
  return static_cast<double>((h ^ (h >> 15)) & 0xffffffU) / 16777215.0;
}

/// Bilinear between grid points `cell` pixels apart.
double noise(int x, int y, int cell, int seed) {
  const double gx = static_cast<double>(x) / cell;
  const double gy = static_cast<double>(y) / cell;
  const int x0 = static_cast<int>(std::floor(gx));
  const int y0 = static_cast<int>(std::floor(gy));
  const double fx = gx - x0;
  const double fy = gy - y0;
  const double top = (1.0 - fx) * lattice(x0, y0, seed) + fx * lattice(x0 + 1, y0, seed);
  const double bottom = (1.0 - fx) * lattice(x0, y0 + 1, seed) + fx * lattice(x0 + 1, y0 + 1, seed);
  return (1.0 - fy) * top + fy * bottom;
}

[[noreturn]] void refuse(const std::string& what) {
  throw_invalid("the model fails its self-test: " + what + "; export it again from a trained checkpoint");
}

void check_plane(const std::vector<float>& plane, int width, int height, const char* name) {
  if (plane.size() != static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 2) {
    refuse(std::string(name) + " has another size than the frames");
  }
  float low = plane.front();
  float high = low;
  for (const float value : plane) {
    if (!std::isfinite(value)) {
      refuse(std::string(name) + " holds values that are not finite");
    }
    low = std::min(low, value);
    high = std::max(high, value);
  }
  // Float32 rounding of a constant would stay far below this.
  if (!(high - low > 1e-5F * std::max(1.0F, std::abs(high)))) {
    refuse(std::string(name) + " is the same at every pixel");
  }
}

double largest_difference(const std::vector<float>& a, const std::vector<float>& b) {
  double largest = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    largest = std::max(largest, static_cast<double>(std::abs(a[i] - b[i])));
  }
  return largest;
}

}  // namespace

Image test_frame(int width, int height, int seed, int shift_x, int shift_y) {
  Image image(width, height);
  std::uint8_t* out = image.data();
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      for (int c = 0; c < 3; ++c) {
        const int u = x - shift_x;
        const int v = y - shift_y;
        const double value =
            0.6 * noise(u, v, 24, seed) + 0.3 * noise(u, v, 7, seed + 1) + 0.1 * noise(u, v, 3, seed + 2 + c);
        *out++ = static_cast<std::uint8_t>(std::lround(255.0 * value));
      }
    }
  }
  return image;
}

void test_model(const skills::InferFunction& infer, int width, int height) {
  const Image first = test_frame(width, height, 1, 0, 0);
  FlowField other;
  FlowField moved;
  infer(first.view(), test_frame(width, height, 1, 3, 1).view(), moved, 0.0);
  infer(first.view(), test_frame(width, height, 7, 0, 0).view(), other, 0.0);
  for (const FlowField* field : {&moved, &other}) {
    check_plane(field->flow, width, height, "the flow");
    check_plane(field->uncertainty, width, height, "the uncertainty");
    if (*std::min_element(field->uncertainty.begin(), field->uncertainty.end()) < 0.0F) {
      refuse("an uncertainty is negative");
    }
  }
  if (!(largest_difference(moved.flow, other.flow) > 1e-4) ||
      !(largest_difference(moved.uncertainty, other.uncertainty) > 1e-6)) {
    refuse("its answer does not depend on the frames");
  }
}

double inference_s(const skills::InferFunction& infer, int width, int height) {
  const Image first = test_frame(width, height, 1, 0, 0);
  const Image second = test_frame(width, height, 1, 3, 1);
  FlowField field;
  std::array<double, 5> durations{};
  for (double& duration : durations) {
    const double began = monotonic_s();
    infer(first.view(), second.view(), field, 0.0);
    duration = monotonic_s() - began;
  }
  std::sort(durations.begin(), durations.end());
  return durations[durations.size() / 2];
}

double oldest_command_s(double inference_s, double frame_interval_s) noexcept {
  return frame_interval_s + (inference_s > frame_interval_s ? 2.0 : 1.0) * inference_s;
}

Pace pace(double inference_s, double frame_interval_s, double camera_latency_s) noexcept {
  const double waited_s = inference_s > frame_interval_s ? 0.5 * frame_interval_s : 0.0;
  return {1.0 / std::max(inference_s, frame_interval_s), camera_latency_s + waited_s + inference_s};
}

}  // namespace ajna::flight
