// SPDX-License-Identifier: MIT
#include "ajna/io/video_writer.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <opencv2/videoio.hpp>
#include <string>
#include <utility>
#include <vector>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/io/file.hpp"
#include "ajna/io/image_header.hpp"
#include "ajna/io/quiet_opencv.hpp"

namespace ajna::io {

struct VideoWriter::Impl {
  Impl(const std::filesystem::path& target, int w, int h)
      : path(target), file(std::make_unique<AtomicFile>(target)), width(w), height(h) {}
  std::filesystem::path path;
  std::unique_ptr<AtomicFile> file;  // before the encoder, so destroyed after it has let go of the temporary
  cv::VideoWriter encoder;
  int width;
  int height;
  std::int64_t frames = 0;
  bool closed = false;
};

namespace {

std::string checked_extension(const std::filesystem::path& path) {
  std::string extension = path.extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (extension != ".mp4" && extension != ".avi") {
    throw_invalid("video file '" + path.string() + "' has the unknown extension '" + extension + "': use .mp4 or .avi");
  }
  return extension;
}

bool open_encoder(cv::VideoWriter& encoder, const std::string& file, const std::string& extension, double fps,
                  cv::Size size) {
  const QuietOpenCv quiet;
  const std::vector<int> codecs = extension == ".avi" ? std::vector<int>{cv::VideoWriter::fourcc('M', 'J', 'P', 'G')}
                                                      : std::vector<int>{cv::VideoWriter::fourcc('a', 'v', 'c', '1'),
                                                                         cv::VideoWriter::fourcc('m', 'p', '4', 'v')};
  return std::any_of(codecs.begin(), codecs.end(), [&](int codec) {
    try {
      return encoder.open(file, cv::CAP_FFMPEG, codec, fps, size) || encoder.open(file, codec, fps, size);
    } catch (const cv::Exception&) {
      return false;
    }
  });
}

}  // namespace

VideoWriter::VideoWriter(const std::filesystem::path& path, int width, int height, double fps) {
  const std::string extension = checked_extension(path);
  if (!(fps > 0 && fps <= 1000)) {
    throw_invalid("video '" + path.string() + "' has " + std::to_string(fps) +
                  " frames per second: give more than 0 and at most 1000");
  }
  check_image_size(width, height, path.string());
  impl_ = std::make_unique<Impl>(path, width, height);
  const std::string temporary = std::filesystem::absolute(impl_->file->temporary()).string();
  if (!open_encoder(impl_->encoder, temporary, extension, fps, {(width + 1) / 2 * 2, (height + 1) / 2 * 2})) {
    throw_runtime("video '" + path.string() + "' of " + std::to_string(width) + "x" + std::to_string(height) +
                  " cannot be encoded: OpenCV's video writer (FFmpeg) has no encoder for it");
  }
}

VideoWriter::~VideoWriter() = default;
VideoWriter::VideoWriter(VideoWriter&&) noexcept = default;
VideoWriter& VideoWriter::operator=(VideoWriter&&) noexcept = default;

void VideoWriter::write(const ImageView& frame) {
  const std::string name = impl_->path.string();
  if (impl_->closed) {
    throw_invalid("video '" + name + "' is closed: no frame can be appended");
  }
  if (frame.empty() || frame.channels != 3 || frame.width != impl_->width || frame.height != impl_->height) {
    throw_invalid("frame " + std::to_string(impl_->frames) + " for video '" + name + "' is " +
                  std::to_string(frame.width) + "x" + std::to_string(frame.height) + "x" +
                  std::to_string(frame.channels) + ": " + std::to_string(impl_->width) + "x" +
                  std::to_string(impl_->height) + "x3 was announced");
  }
  // OpenCV takes no const data; cvtColor only reads from it.
  const cv::Mat rgb(frame.height, frame.width, CV_8UC3, const_cast<std::uint8_t*>(frame.data),
                    static_cast<std::size_t>(frame.row_stride));
  cv::Mat bgr;
  cv::cvtColor(rgb, bgr, cv::COLOR_RGB2BGR);
  cv::copyMakeBorder(bgr, bgr, 0, frame.height % 2, 0, frame.width % 2, cv::BORDER_REPLICATE);
  try {
    const QuietOpenCv quiet;
    impl_->encoder.write(bgr);
  } catch (const cv::Exception&) {
    throw_runtime("frame " + std::to_string(impl_->frames) + " of video '" + name +
                  "' cannot be encoded: check the disk");
  }
  ++impl_->frames;
}

void VideoWriter::close() {
  const std::string name = impl_->path.string();
  if (impl_->closed) {
    return;
  }
  impl_->closed = true;
  impl_->encoder.release();
  const std::unique_ptr<AtomicFile> file = std::move(impl_->file);  // gone by the end, committed or not
  if (impl_->frames == 0) {
    throw_invalid("video '" + name + "' has no frames: write at least one");
  }
  double found = 0;
  {
    const QuietOpenCv quiet;
    cv::VideoCapture check(std::filesystem::absolute(file->temporary()).string());
    if (cv::Mat first; check.isOpened() && check.read(first)) {
      found = check.get(cv::CAP_PROP_FRAME_COUNT);
    }
  }
  if (!(std::round(found) >= static_cast<double>(impl_->frames))) {
    throw_runtime("video '" + name + "' holds " + std::to_string(static_cast<std::int64_t>(found)) + " of " +
                  std::to_string(impl_->frames) + " frames: free space on the disk or choose another folder");
  }
  file->commit();
}

void VideoWriter::discard() noexcept {
  if (!impl_->closed) {
    impl_->closed = true;
    impl_->encoder.release();
    impl_->file.reset();
  }
}

std::int64_t VideoWriter::frames_written() const noexcept { return impl_->frames; }

}  // namespace ajna::io
