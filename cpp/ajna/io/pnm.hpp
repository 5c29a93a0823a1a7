// SPDX-License-Identifier: MIT
#pragma once

#include <string>

#include "ajna/base/image_view.hpp"
#include "ajna/io/image_header.hpp"

namespace ajna::io {

/// The header of a PGM or PPM file (P2, P3, P5, P6). Throws Error(kInvalidArgument).
struct PnmHeader {
  int width = 0;                ///< pixels
  int height = 0;               ///< pixels
  int channels = 3;             ///< 1 (PGM) or 3 (PPM)
  int max_value = 255;          ///< 1 to 65535
  bool ascii = false;           ///< P2, P3
  std::size_t data_offset = 0;  ///< first byte of the samples
};
PnmHeader parse_pnm_header(const Bytes& bytes, const std::string& name);

/// Decode to RGB; samples are scaled from max_value to 255. Throws Error(kInvalidArgument) where samples are missing
/// or exceed max_value.
Image decode_pnm(const Bytes& bytes, const std::string& name);

}  // namespace ajna::io
