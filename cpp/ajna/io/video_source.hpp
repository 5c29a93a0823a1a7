// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "ajna/base/image_view.hpp"

namespace ajna::io {

/// One frame with the time at which it was taken.
struct Frame {
  Image image;               ///< RGB
  double timestamp_s = 0.0;  ///< seconds since the first frame (files, folders) or since opening (cameras)
  std::int64_t index = 0;    ///< 0, 1, 2, ...
  std::string name;          ///< file name for folders, "frame 12" otherwise
};

/// What is asked of a camera; it may deliver another size. 0: its own.
struct CameraOptions {
  int width = 0;   ///< pixels
  int height = 0;  ///< pixels
};

/// Before the description of a GStreamer pipeline that ends in an appsink: "gst:v4l2src ! videoconvert ! appsink".
constexpr const char* kGStreamerPrefix = "gst:";

/// Frames from a folder of images, a video file or a camera, behind one interface.
///
/// The first frame is decoded on opening, so that an unreadable source fails there and the size is known. All frames
/// have that size. Not thread-safe; movable.
class VideoSource {
 public:
  /// `source`: a folder (its PNG, JPEG, BMP, PPM, PGM files in natural order: 2 before 10; hidden files and others are
  /// passed over), a video file, a camera index ("0"; write "./0" for a folder of that name) or a GStreamer pipeline
  /// after kGStreamerPrefix, which counts as a camera.
  /// `fps`: overrides the rate that time stamps of folders (30 otherwise) and of files without time stamps follow;
  /// asked of cameras. Throws Error: kFileNotFound; kInvalidArgument for an empty folder, a file that is no video, fps
  /// not in (0, 1e6]; kRuntime for a camera that does not open.
  explicit VideoSource(const std::string& source, std::optional<double> fps = std::nullopt,
                       const CameraOptions& camera = {});
  ~VideoSource();
  VideoSource(VideoSource&&) noexcept;
  VideoSource& operator=(VideoSource&&) noexcept;

  /// The next frame, or nothing at the end. Throws Error where a file of a folder cannot be read or a frame's size
  /// differs from the first one's (kInvalidArgument), or a camera stops delivering (kRuntime).
  std::optional<Frame> next();

  [[nodiscard]] int width() const noexcept;   ///< pixels
  [[nodiscard]] int height() const noexcept;  ///< pixels
  /// Frames per second; 0 where unknown (some cameras).
  [[nodiscard]] double fps() const noexcept;
  /// Number of frames: exact for folders, what the container claims for video files, nothing for cameras.
  [[nodiscard]] std::optional<std::int64_t> frame_count() const noexcept;
  [[nodiscard]] bool is_camera() const noexcept;

  class Impl;  ///< one per kind of source; private to video_source.cpp

 private:
  std::unique_ptr<Impl> impl_;
};

/// Order in which people number files: digit runs compare by value ("a2" < "a10"), the rest by byte.
bool natural_less(std::string_view a, std::string_view b);

/// The image files of a folder in natural order. Throws Error(kFileNotFound, kInvalidArgument, kRuntime).
std::vector<std::filesystem::path> list_images(const std::filesystem::path& folder);

}  // namespace ajna::io
