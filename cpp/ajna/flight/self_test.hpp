// SPDX-License-Identifier: MIT
#pragma once

#include "ajna/base/image_view.hpp"
#include "ajna/skills/signal.hpp"

namespace ajna::flight {

/// A built-in frame: smooth random texture, the same on every machine, moved by whole pixels.
Image test_frame(int width, int height, int seed, int shift_x, int shift_y);

/// Run the network on built-in frames of the size that it will see and refuse it where it is of no use: values that are
/// not finite, a map without any variation, or answers that do not depend on the frames.
/// Throws Error(kInvalidArgument) that says what is wrong, and what `infer` throws.
void test_model(const skills::InferFunction& infer, int width, int height);

/// Median of five runs of the network on built-in frames, seconds. Throws what `infer` throws.
double inference_s(const skills::InferFunction& infer, int width, int height);

/// How old the frame behind the newest command gets, seconds, before the next command replaces it: where a pair takes
/// longer than a frame interval, the network is busy when a frame comes, and twice until the next command is there.
double oldest_command_s(double inference_s, double frame_interval_s) noexcept;

/// How a computer keeps up with a camera.
struct Pace {
  double planning_rate_hz;  ///< frames that are looked at
  double latency_s;         ///< mean time from a frame's exposure to its command
};
/// Of a network that takes `inference_s` a pair. Where that is longer than a frame interval, the newest frame has
/// waited for half of one when its turn comes. `camera_latency_s`: from exposure to delivery.
Pace pace(double inference_s, double frame_interval_s, double camera_latency_s) noexcept;

}  // namespace ajna::flight
