// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace ajna::synth {

/// How frame pairs are augmented; probabilities are per sample. Defaults are those of RAFT's training (Teed and Deng
/// 2020) where it has the operation: brightness to hue, asymmetry, scale and stretch, flips, patches. Rotation and
/// relative motion are as for LiteFlowNet2 and IRR-PWC; the rest is chosen.
struct AugmentConfig {
  // Colour, in this order, each clamped to [0, 1]
  double brightness = 0.2;  ///< largest shift, white = 1
  double contrast = 0.4;    ///< largest relative change of the distance to the mean of the pair
  double hue = 0.16;        ///< largest turn, a full circle = 1
  double saturation = 0.4;  ///< largest relative change
  double gamma = 0.1;       ///< largest relative change of the exponent from 1
  double noise = 0.02;      ///< largest standard deviation of Gaussian noise, white = 1; each sample draws its own
  double color_probability = 1.0;
  double asymmetric_probability = 0.2;  ///< of each frame drawing its own colour changes and blur
  double blur_probability = 0.1;
  double blur_max_px = 1.2;  ///< largest Gaussian sigma

  // Geometry: both frames alike, about a crop at a random place
  double spatial_probability = 0.8;  ///< of scale, stretch and rotation
  double scale_min = -0.2;           ///< powers of two; raised where the crop would not fit into the frame
  double scale_max = 0.5;
  double stretch_probability = 0.8;
  double stretch = 0.2;        ///< largest further scale of each axis, powers of two
  double rotation_deg = 10.0;  ///< largest; where the crop's corners leave the frame, pixels are not valid
  double flip_x_probability = 0.5;
  double flip_y_probability = 0.1;
  double swap_probability = 0.0;  ///< of exchanging the frames; needs the backward flow

  // Geometry: further motion of frame 2
  double relative_probability = 0.5;
  double relative_translation = 0.00375;  ///< largest, as a fraction of the crop's sides
  double relative_rotation_deg = 1.0;     ///< largest
  double relative_scale = 0.015;          ///< largest relative change

  // Patches of the mean colour that hide parts of frame 2
  double patch_probability = 0.5;
  std::int64_t patch_count = 2;  ///< at most
  double patch_min_size = 0.13;  ///< smallest side, as a fraction of the crop's shorter side
  double patch_max_size = 0.27;  ///< largest
};

struct AugmentPreset {
  std::string name;
  std::string summary;  ///< one sentence
  AugmentConfig config;
};

/// "standard": the defaults; "authors": the six photometric changes of the paper's authors (in their published code;
/// each frame on its own) and a crop; "none": a crop at a random place.
const std::vector<AugmentPreset>& augment_presets();

/// Throws Error(kInvalidArgument) that suggests the nearest name.
const AugmentPreset& augment_preset(const std::string& name);

/// Throws Error(kInvalidArgument) that names the first field out of range.
void validate(const AugmentConfig& config);

}  // namespace ajna::synth
