// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "ajna/base/image_view.hpp"

namespace ajna::flight {

/// Monotonic seconds (CLOCK_MONOTONIC): the one clock of the flight, which no time server can move.
double monotonic_s() noexcept;
/// For simulations that run slower than time: from here on that clock runs `scale` times as fast as time. Before
/// anything has looked at the clock. Throws Error(kInvalidArgument) for a scale outside 0.01 to 1.
void slow_time(double scale);

/// A frame and when it was taken.
struct CapturedFrame {
  Image image;              ///< RGB
  double captured_s = 0.0;  ///< monotonic_s() at capture
  std::int64_t index = 0;   ///< counts what the source delivered, damaged frames included
  std::string name;
};

enum class SourceKind : std::uint8_t {
  kFolder,     ///< a folder of images, played back at its time stamps
  kVideo,      ///< a video file, played back at its time stamps
  kCamera,     ///< a V4L2 camera by index
  kGStreamer,  ///< a GStreamer pipeline that ends in an appsink
  kSpool,      ///< a folder into which another program moves images; each is taken as it appears
};
const char* to_string(SourceKind kind) noexcept;

struct SourceOptions {
  SourceKind kind = SourceKind::kCamera;
  std::string path;        ///< folder, file, camera index, or pipeline
  double rate_hz = 30.0;   ///< of folders without time stamps; asked of cameras
  int width = 0;           ///< asked of cameras, pixels; 0: the camera's own
  int height = 0;          ///< likewise
  double latency_s = 0.0;  ///< of a camera, from exposure to delivery: taken off the time of delivery
};

struct SourceResult {
  enum class Kind : std::uint8_t {
    kFrame,
    kNothing,  ///< not yet: ask again
    kDamaged,  ///< something came that is no frame; `problem` says what
    kEnd,      ///< nothing will come any more
  };
  Kind kind = Kind::kNothing;
  CapturedFrame frame;
  std::string problem;
};

/// Frames from somewhere, behind one interface. Used by one thread; next() may block (for a driver's time-out, with a
/// camera that has died), which nothing else waits for.
class FrameSource {
 public:
  virtual ~FrameSource() = default;
  FrameSource() = default;
  FrameSource(const FrameSource&) = delete;
  FrameSource& operator=(const FrameSource&) = delete;
  virtual SourceResult next() = 0;
};

/// A folder may hold "timestamps.txt" with one line per image in natural order: its time in seconds, ascending.
/// Throws Error where the source cannot be opened.
std::unique_ptr<FrameSource> open_source(const SourceOptions& options);

}  // namespace ajna::flight
