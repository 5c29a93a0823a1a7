// SPDX-License-Identifier: MIT
#include "ajna/flight/source.hpp"

#include <poll.h>
#include <sys/inotify.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <optional>
#include <thread>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/video_source.hpp"

namespace ajna::flight {
namespace fs = std::filesystem;
namespace {

/// next() returns at least so often, so that its thread can be ended.
constexpr double kWait_s = 0.05;

SourceResult damaged(std::string problem) {
  SourceResult result;
  result.kind = SourceResult::Kind::kDamaged;
  result.problem = std::move(problem);
  return result;
}

SourceResult of_kind(SourceResult::Kind kind) {
  SourceResult result;
  result.kind = kind;
  return result;
}

/// Recorded frames, each delivered when its time has come.
class Playback {
 public:
  /// Seconds until the frame with this stamp is due; begins with the first one asked for.
  double due_in(double stamp_s) {
    if (!begin_s_) {
      begin_s_ = monotonic_s() - stamp_s;
    }
    return *begin_s_ + stamp_s - monotonic_s();
  }
  [[nodiscard]] double captured_s(double stamp_s) const { return begin_s_.value_or(0.0) + stamp_s; }

  /// Sleeps towards the due time; false where it is still to come.
  bool wait(double stamp_s) {
    const double left = due_in(stamp_s);
    if (left > 0.0) {
      std::this_thread::sleep_for(std::chrono::duration<double>(std::min(left, kWait_s)));
    }
    return left <= kWait_s;
  }

 private:
  std::optional<double> begin_s_;
};

class FolderPlayback final : public FrameSource {
 public:
  explicit FolderPlayback(const SourceOptions& options)
      : files_(io::list_images(options.path)), stamps_s_(stamps(options, files_.size())) {}

  SourceResult next() override {
    if (position_ >= files_.size()) {
      return of_kind(SourceResult::Kind::kEnd);
    }
    const double stamp_s = stamps_s_[position_];
    if (!playback_.wait(stamp_s)) {
      return {};
    }
    const std::size_t i = position_++;
    SourceResult result = of_kind(SourceResult::Kind::kFrame);
    try {
      result.frame.image = io::read_image(files_[i]);
    } catch (const Error& error) {
      return damaged(error.what());
    }
    result.frame.captured_s = playback_.captured_s(stamp_s);
    result.frame.index = static_cast<std::int64_t>(i);
    result.frame.name = files_[i].filename().string();
    return result;
  }

 private:
  static std::vector<double> stamps(const SourceOptions& options, std::size_t count) {
    const fs::path file = fs::path(options.path) / "timestamps.txt";
    std::vector<double> times_s;
    if (!fs::exists(file)) {
      for (std::size_t i = 0; i < count; ++i) {
        times_s.push_back(static_cast<double>(i) / options.rate_hz);
      }
      return times_s;
    }
    std::ifstream stream(file);
    for (double time_s = 0.0; stream >> time_s;) {
      if (!times_s.empty() && time_s <= times_s.back()) {
        throw_invalid("'" + file.string() + "' does not ascend at line " + std::to_string(times_s.size() + 1) +
                      ": give one later time a line, seconds");
      }
      times_s.push_back(time_s);
    }
    if (!stream.eof() || times_s.size() != count) {
      throw_invalid("'" + file.string() + "' gives " + std::to_string(times_s.size()) + " times for " +
                    std::to_string(count) + " images: give one number a line for each");
    }
    const double first_s = times_s.front();
    for (double& time_s : times_s) {
      time_s -= first_s;
    }
    return times_s;
  }

  std::vector<fs::path> files_;
  std::vector<double> stamps_s_;
  std::size_t position_ = 0;
  Playback playback_;
};

class VideoPlayback final : public FrameSource {
 public:
  explicit VideoPlayback(const SourceOptions& options) : video_(options.path) {}

  SourceResult next() override {
    if (!ahead_) {
      ahead_ = video_.next();
    }
    if (!ahead_) {
      return of_kind(SourceResult::Kind::kEnd);
    }
    if (!playback_.wait(ahead_->timestamp_s)) {
      return {};
    }
    SourceResult result = of_kind(SourceResult::Kind::kFrame);
    result.frame = {std::move(ahead_->image), playback_.captured_s(ahead_->timestamp_s), ahead_->index, ahead_->name};
    ahead_.reset();
    return result;
  }

 private:
  io::VideoSource video_;
  std::optional<io::Frame> ahead_;
  Playback playback_;
};

class Camera final : public FrameSource {
 public:
  explicit Camera(const SourceOptions& options)
      : video_(options.kind == SourceKind::kGStreamer ? io::kGStreamerPrefix + options.path : options.path,
               options.rate_hz > 0.0 ? std::optional<double>(options.rate_hz) : std::nullopt,
               io::CameraOptions{options.width, options.height}),
        latency_s_(options.latency_s) {}

  SourceResult next() override {
    auto frame = video_.next();
    if (!frame) {
      return of_kind(SourceResult::Kind::kEnd);
    }
    SourceResult result = of_kind(SourceResult::Kind::kFrame);
    result.frame = {std::move(frame->image), monotonic_s() - latency_s_, frame->index, frame->name};
    return result;
  }

 private:
  io::VideoSource video_;
  double latency_s_;
};

/// Images that another program moves into a folder. The newest is read; those that came with it are passed over.
class Spool final : public FrameSource {
 public:
  explicit Spool(const SourceOptions& options) : folder_(options.path), latency_s_(options.latency_s) {
    if (!fs::is_directory(folder_)) {
      throw_not_found(options.path, "give an existing folder as source.path");
    }
    descriptor_ = ::inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
    if (descriptor_ < 0 || ::inotify_add_watch(descriptor_, folder_.c_str(), IN_MOVED_TO | IN_CLOSE_WRITE) < 0) {
      const std::string why = std::strerror(errno);
      if (descriptor_ >= 0) {
        ::close(descriptor_);
      }
      throw_runtime("folder '" + options.path + "' cannot be watched (" + why + "): check its permissions");
    }
  }
  ~Spool() override { ::close(descriptor_); }
  Spool(const Spool&) = delete;
  Spool& operator=(const Spool&) = delete;

  SourceResult next() override {
    const std::string name = newest();
    if (name.empty()) {
      return {};
    }
    SourceResult result = of_kind(SourceResult::Kind::kFrame);
    result.frame.captured_s = monotonic_s() - latency_s_;
    result.frame.index = index_++;
    result.frame.name = name;
    try {
      result.frame.image = io::read_image(folder_ / name);
    } catch (const Error& error) {
      return damaged(error.what());
    }
    return result;
  }

 private:
  /// Name of the last file that has appeared since the last call; hidden ones are still being written.
  std::string newest() {
    pollfd waiting{descriptor_, POLLIN, 0};
    ::poll(&waiting, 1, static_cast<int>(kWait_s * 1e3));
    std::string name;
    alignas(inotify_event) std::array<char, 16384> buffer{};
    for (;;) {
      const ssize_t count = ::read(descriptor_, buffer.data(), buffer.size());
      if (count <= 0) {
        return name;
      }
      for (ssize_t at = 0; at < count;) {
        const auto* event = reinterpret_cast<const inotify_event*>(buffer.data() + at);
        if (event->len > 0 && event->name[0] != '.') {
          name = event->name;
        }
        at += static_cast<ssize_t>(sizeof(inotify_event) + event->len);
      }
    }
  }

  fs::path folder_;
  double latency_s_;
  int descriptor_ = -1;
  std::int64_t index_ = 0;
};

std::atomic<double>& time_scale() noexcept {
  static std::atomic<double> scale{1.0};
  return scale;
}

}  // namespace

double monotonic_s() noexcept {
  return time_scale().load(std::memory_order_relaxed) *
         std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void slow_time(double scale) {
  if (!(scale >= 0.01 && scale <= 1.0)) {
    throw_invalid("time scale " + std::to_string(scale) + ": give 0.01 to 1");
  }
  time_scale() = scale;
}

const char* to_string(SourceKind kind) noexcept {
  switch (kind) {
    case SourceKind::kFolder:
      return "folder";
    case SourceKind::kVideo:
      return "video";
    case SourceKind::kCamera:
      return "camera";
    case SourceKind::kGStreamer:
      return "gstreamer";
    case SourceKind::kSpool:
      return "spool";
  }
  return "unknown";
}

std::unique_ptr<FrameSource> open_source(const SourceOptions& options) {
  switch (options.kind) {
    case SourceKind::kFolder:
      return std::make_unique<FolderPlayback>(options);
    case SourceKind::kVideo:
      return std::make_unique<VideoPlayback>(options);
    case SourceKind::kSpool:
      return std::make_unique<Spool>(options);
    case SourceKind::kCamera:
    case SourceKind::kGStreamer:
      break;
  }
  return std::make_unique<Camera>(options);
}

}  // namespace ajna::flight
