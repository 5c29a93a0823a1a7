// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>
#include <optional>

namespace ajna::tasks {

struct BackgroundOptions {
  bool use = true;         ///< false: every map is judged by itself
  double smooth_px = 3.0;  ///< standard deviation of the Gaussian, about the size of what is looked for
  int border_px = 4;       ///< margin that is not looked at: there, motion leaves the image
  double learn_s = 0.2;    ///< time constant of the mean; nothing is said before so much has been seen
  double absorb_s = 1.0;   ///< the same, of what stands out, and of how much each pixel varies
  double deviations =
      3.0;  ///< so many times its mean absolute deviation a pixel must rise: lights blink again and again
  double min_rise = 0.006;     ///< over the mean, in units of the map, whatever the noise ...
  double noise_factor = 3.0;   ///< ... and in units of what 99 of 100 pixels do not rise by
  double max_share = 0.25;     ///< of the picture that may rise at once: more, and the camera has moved
  double max_turn_rad = 0.03;  ///< of the camera since the last map; more, and all is learned anew
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const BackgroundOptions& options);

/// What is new in a map.
struct Rise {
  cv::Mat map;             ///< CV_32F, smoothed: by how much each pixel is above what it usually is, else 0
  double threshold = 0.0;  ///< what counts, in units of the map
};

/// The uncertainty that a camera at rest sees where nothing happens, pixel by pixel, and what rises above it.
///
/// A network is not equally sure everywhere: flat and repetitive surfaces, the rim of the picture and depth edges have
/// an uncertainty of their own, which stays as long as the camera does. What it varies by from map to map is a
/// small part of that, so a small or slow thing is seen long before it stands out of the map itself.
class MapBackground {
 public:
  explicit MapBackground(const BackgroundOptions& options = {});
  /// Learn from a valid map (see is_valid_map). Nothing while the mean is not yet known, or after the camera has moved.
  /// turned_rad: by what angle, since the last map.
  std::optional<Rise> step(const cv::Mat& map, double time_s, double turned_rad = 0.0);
  void reset() noexcept;

 private:
  BackgroundOptions options_;
  cv::Mat mean_;
  cv::Mat deviation_;  ///< running mean of the absolute difference from the mean
  double begin_s_ = 0.0;
  double last_s_ = 0.0;
  double noise_ = 0.0;  ///< what 99 of 100 pixels do not rise by, running mean
};

}  // namespace ajna::tasks
