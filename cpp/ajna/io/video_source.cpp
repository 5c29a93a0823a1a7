// SPDX-License-Identifier: MIT
#include "ajna/io/video_source.hpp"

#include <algorithm>
#include <array>
#include <cctype>
#include <charconv>
#include <chrono>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <opencv2/videoio.hpp>
#include <opencv2/videoio/registry.hpp>
#include <system_error>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/io/image_header.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/quiet_opencv.hpp"

namespace ajna::io {
namespace fs = std::filesystem;

/// A kind of source: delivers raw frames; VideoSource keeps the look-ahead frame and checks sizes.
class VideoSource::Impl {
 public:
  virtual ~Impl() = default;
  Impl() = default;
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;

  std::optional<Frame> next() {
    std::optional<Frame> frame = std::exchange(ahead_, std::nullopt);
    if (!frame) {
      frame = grab();
    }
    if (frame && (frame->image.width() != width_ || frame->image.height() != height_)) {
      throw_invalid("'" + frame->name + "' of '" + source_ + "' is " + std::to_string(frame->image.width()) + "x" +
                    std::to_string(frame->image.height()) + " but the first frame is " + std::to_string(width_) + "x" +
                    std::to_string(height_) + ": give frames of equal size");
    }
    return frame;
  }

  /// Decode the first frame; false where there is none.
  bool open(const std::string& source) {
    source_ = source;
    ahead_ = grab();
    if (ahead_) {
      width_ = ahead_->image.width();
      height_ = ahead_->image.height();
    }
    return ahead_.has_value();
  }

  [[nodiscard]] int width() const noexcept { return width_; }
  [[nodiscard]] int height() const noexcept { return height_; }
  [[nodiscard]] virtual double fps() const noexcept = 0;
  [[nodiscard]] virtual std::optional<std::int64_t> frame_count() const noexcept = 0;
  [[nodiscard]] virtual bool is_camera() const noexcept { return false; }

 protected:
  virtual std::optional<Frame> grab() = 0;

 private:
  std::string source_;
  std::optional<Frame> ahead_;
  int width_ = 0;
  int height_ = 0;
};

namespace {

constexpr double kDefaultFps = 30.0;

class FolderSource final : public VideoSource::Impl {
 public:
  FolderSource(std::vector<fs::path> files, double fps) : files_(std::move(files)), fps_(fps) {}
  [[nodiscard]] double fps() const noexcept override { return fps_; }
  [[nodiscard]] std::optional<std::int64_t> frame_count() const noexcept override {
    return static_cast<std::int64_t>(files_.size());
  }

 protected:
  std::optional<Frame> grab() override {
    if (position_ == files_.size()) {
      return std::nullopt;
    }
    const auto index = static_cast<std::int64_t>(position_);
    const fs::path& file = files_[position_++];
    return Frame{read_image(file), static_cast<double>(index) / fps_, index, file.filename().string()};
  }

 private:
  std::vector<fs::path> files_;
  double fps_;
  std::size_t position_ = 0;
};

/// A video file or a camera through OpenCV.
class CaptureSource final : public VideoSource::Impl {
 public:
  CaptureSource(const cv::VideoCapture& capture, std::optional<double> fps, bool camera)
      : capture_(capture), camera_(camera), opened_(std::chrono::steady_clock::now()) {
    const double claimed = capture_.get(cv::CAP_PROP_FPS);
    fps_ = fps.value_or(std::isfinite(claimed) && claimed > 0 && claimed <= 1e6 ? claimed : 0.0);
    forced_rate_ = fps.has_value();
    const double count = capture_.get(cv::CAP_PROP_FRAME_COUNT);
    if (!camera && std::isfinite(count) && count >= 1 && count < 1e12) {
      count_ = static_cast<std::int64_t>(count);
    }
  }
  [[nodiscard]] double fps() const noexcept override { return fps_; }
  [[nodiscard]] std::optional<std::int64_t> frame_count() const noexcept override { return count_; }
  [[nodiscard]] bool is_camera() const noexcept override { return camera_; }

 protected:
  std::optional<Frame> grab() override {
    cv::Mat bgr;
    try {
      const QuietOpenCv quiet;
      if (!capture_.read(bgr) || bgr.empty()) {
        bgr.release();
      }
    } catch (const cv::Exception&) {
      bgr.release();
    }
    if (bgr.empty()) {
      if (camera_ && index_ > 0) {
        throw_runtime("the camera stopped after frame " + std::to_string(index_ - 1) + ": check its cable");
      }
      return std::nullopt;
    }
    const std::string name = "frame " + std::to_string(index_);
    check_image_size(bgr.cols, bgr.rows, name);
    if (bgr.depth() != CV_8U || (bgr.channels() != 1 && bgr.channels() != 3)) {
      throw_invalid("'" + name + "' has " + std::to_string(bgr.channels()) +
                    " channels of an unusual depth: convert the video to 8-bit colour");
    }
    Frame frame{Image(bgr.cols, bgr.rows), timestamp(), index_, name};
    ++index_;
    cv::Mat rgb(bgr.rows, bgr.cols, CV_8UC3, frame.image.data());
    cv::cvtColor(bgr, rgb, bgr.channels() == 1 ? cv::COLOR_GRAY2RGB : cv::COLOR_BGR2RGB);
    return frame;
  }

 private:
  double timestamp() {
    if (camera_) {
      return std::chrono::duration<double>(std::chrono::steady_clock::now() - opened_).count();
    }
    // The container's own time where it moves forward (variable frame rates), else the nominal rate.
    const double stamp = capture_.get(cv::CAP_PROP_POS_MSEC) / 1e3;
    const double nominal = static_cast<double>(index_) / (fps_ > 0 ? fps_ : kDefaultFps);
    if (index_ == 0) {
      first_stamp_ = std::isfinite(stamp) ? stamp : 0.0;
      last_ = 0.0;
      return 0.0;
    }
    const double own = stamp - first_stamp_;
    last_ = !forced_rate_ && std::isfinite(own) && own > last_ ? own : std::max(nominal, last_);
    return last_;
  }

  cv::VideoCapture capture_;
  bool camera_;
  std::chrono::steady_clock::time_point opened_;
  bool forced_rate_ = false;
  double fps_ = 0.0;
  std::optional<std::int64_t> count_;
  std::int64_t index_ = 0;
  double first_stamp_ = 0.0;
  double last_ = 0.0;
};

bool is_index(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return c >= '0' && c <= '9'; });
}

bool is_image_name(const fs::path& path) {
  static constexpr std::array<std::string_view, 6> kExtensions = {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm"};
  std::string extension = path.extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return std::find(kExtensions.begin(), kExtensions.end(), extension) != kExtensions.end();
}

cv::VideoCapture open_pipeline(const std::string& source) {
  const std::string pipeline = source.substr(std::string_view(kGStreamerPrefix).size());
  const QuietOpenCv quiet;
  try {
    cv::VideoCapture capture;
    if (capture.open(pipeline, cv::CAP_GSTREAMER)) {
      return capture;
    }
  } catch (const cv::Exception&) {  // reported below
  }
  throw_runtime("GStreamer pipeline '" + pipeline +
                "' cannot be opened: try it with gst-launch-1.0, and let it end in 'videoconvert ! appsink drop=true'");
}

cv::VideoCapture open_camera(const std::string& source, std::optional<double> fps, const CameraOptions& wanted) {
  int index = 0;
  const auto [end, error] = std::from_chars(source.data(), source.data() + source.size(), index);
  if (error != std::errc{} || end != source.data() + source.size() || index > 999) {
    throw_invalid("camera index " + source + " is absurd: give 0 to 999");
  }
  const QuietOpenCv quiet;
  try {
    cv::VideoCapture capture;
    if (capture.open(index, cv::CAP_V4L2) || capture.open(index, cv::CAP_ANY)) {
      if (wanted.width > 0 && wanted.height > 0) {
        capture.set(cv::CAP_PROP_FRAME_WIDTH, wanted.width);
        capture.set(cv::CAP_PROP_FRAME_HEIGHT, wanted.height);
      }
      if (fps) {
        capture.set(cv::CAP_PROP_FPS, *fps);
      }
      // A driver's queue of old frames is the last thing wanted; not every backend lets it be shortened.
      capture.set(cv::CAP_PROP_BUFFERSIZE, 1);
      return capture;
    }
  } catch (const cv::Exception&) {  // reported below
  }
  throw_runtime("camera " + source + " cannot be opened: check that it is connected and not in use, or give a file");
}

cv::VideoCapture open_file(const fs::path& path) {
  // By name, because CAP_ANY would try the image-sequence reader, which turns "clip_01.txt" into a pattern.
  const auto backends = cv::videoio_registry::getStreamBackends();
  const bool has_ffmpeg = std::find(backends.begin(), backends.end(), cv::CAP_FFMPEG) != backends.end();
  const QuietOpenCv quiet;
  try {
    cv::VideoCapture capture;
    // An absolute path: FFmpeg would take "http:..." or "concat:..." for a protocol.
    if (capture.open(fs::absolute(path).string(), has_ffmpeg ? cv::CAP_FFMPEG : cv::CAP_GSTREAMER)) {
      return capture;
    }
  } catch (const cv::Exception&) {  // reported below
  }
  throw_invalid("file '" + path.string() +
                "' is not a readable video: give a video file, a folder of images or a camera index");
}

std::unique_ptr<VideoSource::Impl> open_source(const std::string& source, std::optional<double> fps,
                                               const CameraOptions& wanted) {
  if (fps && !(*fps > 0 && *fps <= 1e6)) {
    throw_invalid("fps " + std::to_string(*fps) + " is out of range: give more than 0 and at most 1e6");
  }
  if (source.empty()) {
    throw_invalid("video source '' is empty: give a folder of images, a video file or a camera index");
  }
  const bool is_pipeline = source.rfind(kGStreamerPrefix, 0) == 0;
  if (is_pipeline || is_index(source)) {
    auto camera = std::make_unique<CaptureSource>(
        is_pipeline ? open_pipeline(source) : open_camera(source, fps, wanted), fps, true);
    if (!camera->open("camera " + source)) {
      throw_runtime("camera " + source + " delivers no frame: check that it is not in use");
    }
    return camera;
  }
  std::error_code error;
  const fs::file_status status = fs::status(source, error);
  std::unique_ptr<VideoSource::Impl> opened;
  if (fs::is_directory(status)) {
    opened = std::make_unique<FolderSource>(list_images(source), fps.value_or(kDefaultFps));
  } else {
    // Reads no content; missing files, pipes and unreadable files get their own sentence.
    if (!fs::exists(status)) {
      throw_not_found(source, "give a folder of images, a video file or a camera index");
    }
    if (!fs::is_regular_file(status)) {
      throw_invalid("'" + source + "' is a device or a pipe: give a folder, a video file or a camera index");
    }
    if (is_image_name(source)) {
      throw_invalid("'" + source + "' is a single image: give a folder of images or a video file");
    }
    opened = std::make_unique<CaptureSource>(open_file(source), fps, false);
  }
  if (!opened->open(source)) {
    throw_invalid("video '" + source + "' holds no frame that can be decoded: get a good copy");
  }
  return opened;
}

}  // namespace

VideoSource::VideoSource(const std::string& source, std::optional<double> fps, const CameraOptions& camera)
    : impl_(open_source(source, fps, camera)) {}
VideoSource::~VideoSource() = default;
VideoSource::VideoSource(VideoSource&&) noexcept = default;
VideoSource& VideoSource::operator=(VideoSource&&) noexcept = default;
std::optional<Frame> VideoSource::next() { return impl_->next(); }
int VideoSource::width() const noexcept { return impl_->width(); }
int VideoSource::height() const noexcept { return impl_->height(); }
double VideoSource::fps() const noexcept { return impl_->fps(); }
std::optional<std::int64_t> VideoSource::frame_count() const noexcept { return impl_->frame_count(); }
bool VideoSource::is_camera() const noexcept { return impl_->is_camera(); }

bool natural_less(std::string_view a, std::string_view b) {
  const auto is_digit = [](char c) { return c >= '0' && c <= '9'; };
  std::size_t i = 0;
  std::size_t j = 0;
  while (i < a.size() && j < b.size()) {
    if (is_digit(a[i]) && is_digit(b[j])) {
      const auto run = [&](std::string_view text, std::size_t& position) {
        const std::size_t begin = position;
        while (position < text.size() && is_digit(text[position])) {
          ++position;
        }
        std::string_view digits = text.substr(begin, position - begin);
        digits.remove_prefix(std::min(digits.find_first_not_of('0'), digits.size()));
        return digits;
      };
      const std::string_view x = run(a, i);
      const std::string_view y = run(b, j);
      if (x.size() != y.size()) {
        return x.size() < y.size();
      }
      if (x != y) {
        return x < y;
      }
    } else if (a[i] != b[j]) {
      return static_cast<unsigned char>(a[i]) < static_cast<unsigned char>(b[j]);
    } else {
      ++i;
      ++j;
    }
  }
  if (i == a.size() && j == b.size()) {
    return a < b;  // "a01" and "a1": equal by value; keep the order strict
  }
  return i == a.size();
}

std::vector<fs::path> list_images(const fs::path& folder) {
  std::error_code error;
  if (!fs::exists(folder, error)) {
    throw_not_found(folder.string(), "give a folder of images");
  }
  std::vector<fs::path> files;
  fs::directory_iterator entries(folder, error);
  for (; !error && entries != fs::directory_iterator(); entries.increment(error)) {
    const fs::path& path = entries->path();
    std::error_code ignored;
    if (is_image_name(path) && path.filename().string().front() != '.' && !entries->is_directory(ignored)) {
      files.push_back(path);
    }
  }
  if (error) {
    throw_runtime("folder '" + folder.string() + "' cannot be listed (" + error.message() + "): check its permissions");
  }
  if (files.empty()) {
    throw_invalid("folder '" + folder.string() + "' holds no images: PNG, JPEG, BMP, PPM and PGM files are read");
  }
  std::sort(files.begin(), files.end(), [](const fs::path& a, const fs::path& b) {
    return natural_less(a.filename().string(), b.filename().string());
  });
  return files;
}

}  // namespace ajna::io
