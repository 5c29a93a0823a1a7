// SPDX-License-Identifier: MIT
#pragma once

#include <filesystem>
#include <vector>

namespace ajna::io {

/// A float image, height x width x channels, interleaved, top row first.
struct FloatImage {
  int width = 0;            ///< pixels
  int height = 0;           ///< pixels
  int channels = 1;         ///< interleaved planes
  std::vector<float> data;  ///< width * height * channels values
};

/// Read a portable float map: "Pf" (1 channel) or "PF" (3 channels), either byte order (a negative scale means little
/// endian; the scale's magnitude carries no agreed meaning and is ignored). The file's rows run bottom up; the result
/// is top down. Any float is accepted, NaN and infinities included (disparity maps mark unknowns so).
/// Throws Error: kFileNotFound; kInvalidArgument for a bad header or a length that does not match it.
FloatImage read_pfm(const std::filesystem::path& path);

/// Write 1, 2 or 3 channels, little endian, atomically. Two channels (flow, uncertainty) are stored as three with a
/// zero third one, as FlyingThings3D does. Throws Error: kInvalidArgument for other channel counts, empty images and
/// a data size that does not match; kRuntime where the system refuses to write.
void write_pfm(const std::filesystem::path& path, const float* data, int width, int height, int channels);

}  // namespace ajna::io
