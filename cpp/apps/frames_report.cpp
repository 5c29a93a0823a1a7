// SPDX-License-Identifier: MIT
#include "apps/frames_report.hpp"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <opencv2/core/utility.hpp>
#include <optional>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/base/flow_field.hpp"
#include "ajna/flight/json_line.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/video_source.hpp"

namespace ajna::apps {
namespace {

constexpr int kMaxSide = 16384;

struct Size {
  int width, height;
};

std::optional<Size> parse_size(const std::string& text) {
  if (text.empty()) {
    return std::nullopt;
  }
  Size size{0, 0};
  const char* const end = text.data() + text.size();
  const auto width = std::from_chars(text.data(), end, size.width);
  const bool has_separator = width.ec == std::errc() && width.ptr != end && *width.ptr == 'x';
  const auto height = has_separator ? std::from_chars(width.ptr + 1, end, size.height) : width;
  if (!has_separator || height.ec != std::errc() || height.ptr != end || size.width < 1 || size.height < 1 ||
      size.width > kMaxSide || size.height > kMaxSide) {
    throw_invalid("--size '" + text + "': give WIDTHxHEIGHT with sides of 1 to " + std::to_string(kMaxSide) +
                  " pixels, for example 320x240");
  }
  return size;
}

struct NamedFrame {
  std::string name;
  Image image;
};

/// The value below which a share `quantile` of `sorted` lies (nearest rank).
double quantile_of(const std::vector<double>& sorted, double quantile) {
  const auto rank = static_cast<std::size_t>(std::lround(quantile * static_cast<double>(sorted.size() - 1)));
  return sorted[rank];
}

class FramesReport {
 public:
  explicit FramesReport(const FramesOptions& options)
      : size_(parse_size(options.size)),
        paths_(list_frames(options)),
        engine_(engine::FlowEngine::load(options.model, options.engine)) {
    const auto& info = engine_.info();
    spdlog::info("model {} ({}, {} parameters, {} on {})", info.name, info.format, info.parameters, info.precision,
                 info.device);
    if (options.engine.threads > 0) {
      cv::setNumThreads(options.engine.threads);
    }
  }

  void run() {
    std::optional<NamedFrame> previous;
    for (const auto& path : paths_) {
      auto current = read(path);
      if (previous && current) {
        process(*previous, *current);
      }
      // After a frame that could not be read the flow would span two intervals: begin anew behind it.
      previous = std::move(current);
    }
    summarize();
  }

 private:
  static std::vector<std::filesystem::path> list_frames(const FramesOptions& options) {
    auto paths = io::list_images(options.frames);
    if (options.max_frames > 0 && paths.size() > static_cast<std::size_t>(options.max_frames)) {
      paths.resize(static_cast<std::size_t>(options.max_frames));
    }
    if (paths.size() < 2) {
      throw_invalid("folder '" + options.frames + "' gives " + std::to_string(paths.size()) +
                    " image: flow needs at least 2 frames");
    }
    return paths;
  }

  /// The frame, or nothing (and a word about it) where it is damaged or of another size.
  std::optional<NamedFrame> read(const std::filesystem::path& path) {
    try {
      NamedFrame frame{path.filename().string(), io::read_image(path)};
      if (size_) {
        frame.image = io::resize_image(frame.image.view(), size_->width, size_->height);
      }
      if (!first_size_) {
        first_size_ = Size{frame.image.width(), frame.image.height()};
        engine_.warm_up(first_size_->width, first_size_->height);
      }
      if (frame.image.width() != first_size_->width || frame.image.height() != first_size_->height) {
        throw_invalid(fmt::format("it is {}x{} but the frames before are {}x{}: give --size", frame.image.width(),
                                  frame.image.height(), first_size_->width, first_size_->height));
      }
      return frame;
    } catch (const Error& error) {
      ++skipped_;
      spdlog::warn("frame '{}' skipped: {}", path.filename().string(), error.what());
      return std::nullopt;
    }
  }

  void process(const NamedFrame& frame1, const NamedFrame& frame2) {
    const auto start = std::chrono::steady_clock::now();
    engine_.infer_into(frame1.image.view(), frame2.image.view(), field_);
    const std::chrono::duration<double, std::milli> latency = std::chrono::steady_clock::now() - start;
    const FlowSummary summary = ajna::summarize(field_);
    fmt::print(
        "{{\"index\": {}, \"frame1\": {}, \"frame2\": {}, \"latency_ms\": {:.3f}, \"mean_flow_px\": {:.6g}, "
        "\"mean_uncertainty\": {:.6g}, \"mean_expected_error_px\": {:.6g}}}\n",
        latencies_ms_.size(), flight::json_string(frame1.name), flight::json_string(frame2.name), latency.count(),
        summary.mean_flow_px, summary.mean_uncertainty, summary.mean_expected_error_px);
    std::fflush(stdout);  // a reader follows live
    latencies_ms_.push_back(latency.count());
  }

  void summarize() const {
    if (latencies_ms_.empty()) {
      throw_invalid("no two frames in a row could be used (" + std::to_string(skipped_) + " of " +
                    std::to_string(paths_.size()) + " skipped): check the folder's images");
    }
    auto sorted = latencies_ms_;
    std::sort(sorted.begin(), sorted.end());
    spdlog::info("{} pairs of {}x{}, {} frames skipped, latency median {:.1f} ms, p95 {:.1f} ms; nothing was sent",
                 sorted.size(), first_size_->width, first_size_->height, skipped_, quantile_of(sorted, 0.5),
                 quantile_of(sorted, 0.95));
  }

  std::optional<Size> size_, first_size_;
  std::vector<std::filesystem::path> paths_;
  engine::FlowEngine engine_;
  FlowField field_;
  std::vector<double> latencies_ms_;
  int skipped_ = 0;
};

}  // namespace

void report_frames(const FramesOptions& options) { FramesReport(options).run(); }

}  // namespace ajna::apps
