// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <vector>

namespace ajna::io {

/// Optical flow as data sets store it: float32 pixels, height x width x 2 interleaved (u right, v down).
struct FlowImage {
  int width = 0;                    ///< pixels
  int height = 0;                   ///< pixels
  std::vector<float> flow;          ///< (u, v) of every pixel, pixels per frame interval
  std::vector<std::uint8_t> valid;  ///< height x width: 1 where the flow is known, 0 elsewhere
};

/// A borrowed flow to write: `flow` has 2 * width * height values; `valid` is null (all known) or width * height.
struct FlowView {
  const float* flow = nullptr;
  const std::uint8_t* valid = nullptr;
  int width = 0;
  int height = 0;
};

/// A .flo component beyond this magnitude, or NaN, means "unknown" (Middlebury's convention).
inline constexpr float kUnknownFlowThreshold = 1e9F;
/// What write_flo stores where the flow is unknown.
inline constexpr float kUnknownFlow = 1e10F;

/// 1 for each pixel whose two components are known (not NaN, |component| <= kUnknownFlowThreshold).
std::vector<std::uint8_t> known_flow(const float* flow, std::size_t pixels);

/// Middlebury .flo (magic 202021.25, little endian). Unknown values are kept as stored and marked in `valid`.
/// Throws Error: kFileNotFound; kInvalidArgument for a wrong magic, sizes that are not positive or do not match the
/// length of the file (truncated, lying header, trailing bytes).
FlowImage read_flo(const std::filesystem::path& path);
/// Atomic. Invalid pixels are stored as kUnknownFlow. Throws Error(kInvalidArgument) where a valid pixel is unknown
/// by its value (NaN, infinite, or beyond kUnknownFlowThreshold), kRuntime where the system refuses to write.
void write_flo(const std::filesystem::path& path, const FlowView& flow);

/// KITTI's 16-bit RGB PNG: u = (R - 32768) / 64, v = (G - 32768) / 64, valid = B > 0; the flow is 0 where invalid.
/// Throws Error: kFileNotFound; kInvalidArgument for anything but a whole 16-bit RGB PNG.
FlowImage read_kitti_flow(const std::filesystem::path& path);
/// Atomic; rounds to 1/64 pixel. Throws Error(kInvalidArgument) where a valid component is not finite or outside
/// [-512, 511.98] pixels, kRuntime where the system refuses to write.
void write_kitti_flow(const std::filesystem::path& path, const FlowView& flow);

}  // namespace ajna::io
