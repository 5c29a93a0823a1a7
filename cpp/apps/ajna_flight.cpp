// SPDX-License-Identifier: MIT
//
// The onboard program: frames through the engine. This version only measures and reports (--dry-run); it talks to no
// autopilot. stdout carries one line of JSON per frame pair, stderr everything that is meant for people.
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/base/flow_field.hpp"
#include "ajna/base/version.hpp"
#include "ajna/engine/flow_engine.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/video_source.hpp"

namespace {

constexpr int kBadInput = 2;
constexpr int kMaxSide = 16384;

struct Options {
  std::string model;
  std::string frames;
  bool dry_run = false;
  ajna::engine::EngineOptions engine;
  std::string size;
  std::int64_t max_frames = 0;  // 0: all
};

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
    ajna::throw_invalid("--size '" + text + "': give WIDTHxHEIGHT with sides of 1 to " + std::to_string(kMaxSide) +
                        " pixels, for example 320x240");
  }
  return size;
}

std::string json_string(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') {
      out += '\\';
      out += c;
    } else if (static_cast<unsigned char>(c) < 0x20) {
      out += fmt::format("\\u{:04x}", static_cast<unsigned>(c));
    } else {
      out += c;
    }
  }
  return out + '"';
}

struct NamedFrame {
  std::string name;
  ajna::Image image;
};

/// Averages over the pixels that fall together, as the training data were scaled.
ajna::Image resize(const ajna::Image& image, Size size) {
  ajna::Image result(size.width, size.height);
  // OpenCV's header takes no const memory; the source is only read.
  const cv::Mat from(image.height(), image.width(), CV_8UC3, const_cast<std::uint8_t*>(image.data()));
  cv::Mat to(size.height, size.width, CV_8UC3, result.data());
  cv::resize(from, to, to.size(), 0, 0, cv::INTER_AREA);
  return result;
}

/// The value below which a share `quantile` of `sorted` lies (nearest rank).
double quantile_of(const std::vector<double>& sorted, double quantile) {
  const auto rank = static_cast<std::size_t>(std::lround(quantile * static_cast<double>(sorted.size() - 1)));
  return sorted[rank];
}

class Flight {
 public:
  explicit Flight(const Options& options)
      : size_(parse_size(options.size)),
        paths_(list_frames(options)),
        engine_(ajna::engine::FlowEngine::load(options.model, options.engine)) {
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
  static std::vector<std::filesystem::path> list_frames(const Options& options) {
    auto paths = ajna::io::list_images(options.frames);
    if (options.max_frames > 0 && paths.size() > static_cast<std::size_t>(options.max_frames)) {
      paths.resize(static_cast<std::size_t>(options.max_frames));
    }
    if (paths.size() < 2) {
      ajna::throw_invalid("folder '" + options.frames + "' gives " + std::to_string(paths.size()) +
                          " image: flow needs at least 2 frames");
    }
    return paths;
  }

  /// The frame, or nothing (and a word about it) where it is damaged or of another size.
  std::optional<NamedFrame> read(const std::filesystem::path& path) {
    try {
      NamedFrame frame{path.filename().string(), ajna::io::read_image(path)};
      if (size_) {
        frame.image = resize(frame.image, *size_);
      }
      if (!first_size_) {
        first_size_ = Size{frame.image.width(), frame.image.height()};
        engine_.warm_up(first_size_->width, first_size_->height);
      }
      if (frame.image.width() != first_size_->width || frame.image.height() != first_size_->height) {
        ajna::throw_invalid(fmt::format("it is {}x{} but the frames before are {}x{}: give --size", frame.image.width(),
                                        frame.image.height(), first_size_->width, first_size_->height));
      }
      return frame;
    } catch (const ajna::Error& error) {
      ++skipped_;
      spdlog::warn("frame '{}' skipped: {}", path.filename().string(), error.what());
      return std::nullopt;
    }
  }

  void process(const NamedFrame& frame1, const NamedFrame& frame2) {
    const auto start = std::chrono::steady_clock::now();
    engine_.infer_into(frame1.image.view(), frame2.image.view(), field_);
    const std::chrono::duration<double, std::milli> latency = std::chrono::steady_clock::now() - start;
    const ajna::FlowSummary summary = ajna::summarize(field_);
    fmt::print(
        "{{\"index\": {}, \"frame1\": {}, \"frame2\": {}, \"latency_ms\": {:.3f}, \"mean_flow_px\": {:.6g}, "
        "\"mean_uncertainty\": {:.6g}, \"mean_expected_error_px\": {:.6g}}}\n",
        latencies_ms_.size(), json_string(frame1.name), json_string(frame2.name), latency.count(), summary.mean_flow_px,
        summary.mean_uncertainty, summary.mean_expected_error_px);
    std::fflush(stdout);  // a reader follows live
    latencies_ms_.push_back(latency.count());
  }

  void summarize() const {
    if (latencies_ms_.empty()) {
      ajna::throw_invalid("no two frames in a row could be used (" + std::to_string(skipped_) + " of " +
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
  ajna::engine::FlowEngine engine_;
  ajna::FlowField field_;
  std::vector<double> latencies_ms_;
  int skipped_ = 0;
};

int fail(const std::string& message) {
  spdlog::error("{}", message);
  return kBadInput;
}

}  // namespace

int main(int argc, char** argv) {
  auto logger = spdlog::stderr_color_mt("ajna_flight");
  logger->set_pattern("%n: %^%l%$: %v");
  spdlog::set_default_logger(logger);

  Options options;
  CLI::App app{
      "Flow and uncertainty for a folder of frames: one line of JSON per frame pair on stdout.\n"
      "Example: ajna_flight --model ajna.safetensors --frames frames/ --dry-run"};
  app.set_version_flag("--version", ajna::kVersion);
  app.add_option("--model", options.model, "Checkpoint (.safetensors) or TorchScript file (.pt, .torchscript)")
      ->required();
  app.add_option("--frames", options.frames, "Folder of images, taken in natural order of their names")->required();
  app.add_flag("--dry-run", options.dry_run, "Report only; the one mode of this version");
  app.add_option("--threads", options.engine.threads, "Threads of the network; by default LibTorch's choice")
      ->check(CLI::Range(1, 1024));
  app.add_option("--device", options.engine.device, "cpu, cuda or cuda:<index>")->capture_default_str();
  app.add_option("--size", options.size, "Resize the frames first, as WIDTHxHEIGHT");
  app.add_option("--max-frames", options.max_frames, "Use only so many frames")
      ->check(CLI::Range(std::int64_t{2}, std::int64_t{1} << 40));
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return error.get_exit_code() == 0 ? app.exit(error) : fail(std::string(error.what()) + " (see --help)");
  }
  if (!options.dry_run) {
    return fail("this version sends nothing to an autopilot: run it with --dry-run");
  }
  try {
    Flight(options).run();
    return 0;
  } catch (const std::exception& error) {
    return fail(error.what());
  }
}
