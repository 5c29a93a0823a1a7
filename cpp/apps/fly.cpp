// SPDX-License-Identifier: MIT
#include "apps/fly.hpp"

#include <spdlog/async.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <array>
#include <csignal>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <memory>
#include <opencv2/core/utility.hpp>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/base/version.hpp"
#include "ajna/engine/flow_engine.hpp"
#include "ajna/flight/emergency.hpp"
#include "ajna/flight/json_line.hpp"
#include "ajna/flight/self_test.hpp"
#include "apps/flight_config.hpp"

namespace ajna::apps {
namespace {

constexpr double kWatchEvery_s = 0.02;
constexpr double kJoin_s = 2.0;
/// Of the command time-out, how much may be used up on a quiet computer.
constexpr double kSpeedReserve = 0.8;
constexpr std::array kEndSignals = {SIGTERM, SIGINT, SIGHUP};
constexpr std::array kFatalSignals = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};

/// A crash still gives the vehicle back; then it is a crash like any other.
extern "C" void on_fatal_signal(int number) {
  flight::EmergencyRelease::fire();
  ::signal(number, SIG_DFL);
  ::raise(number);
}

/// From here on the main thread alone hears of signals, by waiting for them.
sigset_t take_signals() {
  for (const int number : kFatalSignals) {
    struct sigaction action {};
    action.sa_handler = on_fatal_signal;
    sigemptyset(&action.sa_mask);
    ::sigaction(number, &action, nullptr);
  }
  ::signal(SIGPIPE, SIG_IGN);
  ::signal(SIGXFSZ, SIG_IGN);  // a log that may not grow is an error code, no end
  sigset_t ends;
  sigemptyset(&ends);
  for (const int number : kEndSignals) {
    sigaddset(&ends, number);
  }
  ::pthread_sigmask(SIG_BLOCK, &ends, nullptr);
  return ends;
}

/// A terminal or journal that takes no text for a while (Ctrl-S is enough) must not hold up the flight: from here on a
/// thread of its own writes, and what it cannot write in time is lost.
void write_from_a_thread() {
  constexpr std::size_t kQueue = 1024;
  const auto before = spdlog::default_logger();
  spdlog::init_thread_pool(kQueue, 1);
  spdlog::set_default_logger(std::make_shared<spdlog::async_logger>(before->name(), before->sinks().begin(),
                                                                    before->sinks().end(), spdlog::thread_pool(),
                                                                    spdlog::async_overflow_policy::overrun_oldest));
}

void say(flight::Level level, const std::string& text) {
  switch (level) {
    case flight::Level::kInfo:
      spdlog::info("{}", text);
      break;
    case flight::Level::kWarning:
      spdlog::warn("{}", text);
      break;
    case flight::Level::kError:
      spdlog::error("{}", text);
      break;
  }
}

/// Watch the flight until it has ended: signals end it, and a control loop that stands still is released from here.
void watch(flight::FlightLoop& loop, const sigset_t& ends, double max_tick_s) {
  const timespec wait{0, static_cast<long>(kWatchEvery_s * 1e9)};
  bool late = false;
  while (!loop.finished()) {
    const int number = ::sigtimedwait(&ends, nullptr, &wait);
    if (number > 0) {
      loop.request_stop();
      spdlog::warn("signal {}: ending", number);
    }
    const double age_s = flight::monotonic_s() - loop.last_tick_s();
    if (age_s > max_tick_s) {
      flight::EmergencyRelease::fire();
      if (!std::exchange(late, true)) {
        spdlog::error("the control loop has stood still for {:.0f} ms: released from outside", age_s * 1e3);
      }
    } else {
      late = false;
    }
  }
}

void check_files(const FlightConfig& config) {
  if (!std::filesystem::is_regular_file(config.model_path)) {
    throw_not_found(config.model_path, "give an existing model file as model.path");
  }
  if (!config.signing_key_file.empty()) {
    load_signing_key(config.signing_key_file);
  }
}

/// Time the network on this computer: tell the skill how late it plans where the configuration does not, and say
/// beforehand where that is too late for the configured time-out: releases in flight would tell later.
void take_time(const skills::InferFunction& infer, FlightConfig& config) {
  const double pair_s = flight::inference_s(infer, config.loop.width, config.loop.height);
  const double interval_s = 1.0 / config.source.rate_hz;
  const double oldest_s = flight::oldest_command_s(pair_s, interval_s);
  const double limit_s = config.loop.safety.command_timeout_s;
  spdlog::info("a pair takes {:.0f} ms here: at {:g} frames/s (source.rate_hz), commands get up to {:.0f} ms old",
               pair_s * 1e3, config.source.rate_hz, oldest_s * 1e3);
  if (oldest_s > kSpeedReserve * limit_s) {
    spdlog::warn(
        "that is too close to safety.command_timeout_s ({:.0f} ms): expect releases; choose a smaller model.width_px "
        "and "
        "model.height_px, or a quicker computer",
        limit_s * 1e3);
  }
  const flight::Pace pace = flight::pace(pair_s, interval_s, config.source.latency_s);
  skills::SkillOptions& skill = config.skill;
  if (config.timed_rate) {
    skill.planning_rate_hz =
        std::clamp(pace.planning_rate_hz, skills::kSlowestPlanning_hz, skills::kFastestPlanning_hz);
  }
  if (config.timed_latency) {
    skill.latency_s = std::min(pace.latency_s, skills::kLongestLatency_s);
  }
  spdlog::info("planning at {:.1f} frames/s{}, {:.0f} ms late{}", skill.planning_rate_hz,
               config.timed_rate ? "" : " (task.planning_rate_hz)", skill.latency_s * 1e3,
               config.timed_latency ? "" : " (task.latency_s)");
}

void log_start(flight::FlightLog& log, const FlightConfig& config, const engine::ModelInfo& info, bool dry_run) {
  // The wall clock only names the flight; nothing is measured with it.
  std::array<char, 32> date{};
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  ::gmtime_r(&now, &utc);
  std::strftime(date.data(), date.size(), "%Y-%m-%dT%H:%M:%SZ", &utc);
  log.write(flight::JsonLine()
                .add("type", "start")
                .add("time_s", 0.0)
                .add("version", kVersion)
                .add("date", date.data())
                .add("dry_run", dry_run)
                .add("model", info.name)
                .add("model_path", info.path)
                .add("precision", info.precision)
                .add("task", skills::to_string(config.skill.task))
                .add("planning_rate_hz", config.skill.planning_rate_hz)
                .add("latency_s", config.skill.latency_s)
                .add("source", flight::to_string(config.source.kind))
                .add("endpoint", config.endpoint_text)
                .add("output", flight::to_string(config.output))
                .add("width_px", config.loop.width)
                .add("height_px", config.loop.height)
                .add("frame_every", config.log.frame_every)
                .str());
}

void report_end(flight::FlightLog& log, const flight::LoopStatistics& s) {
  const auto& latency = s.capture_to_command;
  spdlog::info(
      "{} frames ({} dropped, {} stale, {} damaged), {} network failures; {} activations, {} commands and {} releases "
      "sent; capture to command: median {:.0f} ms, p95 {:.0f} ms, p99 {:.0f} ms, max {:.0f} ms",
      s.frames, s.dropped, s.stale, s.damaged, s.network_failures, s.activations, s.commands_sent, s.releases_sent,
      latency.quantile_ms(0.5), latency.quantile_ms(0.95), latency.quantile_ms(0.99), latency.max_ms());
  log.write(flight::JsonLine()
                .add("type", "end")
                .add("frames", s.frames)
                .add("dropped", s.dropped)
                .add("stale", s.stale)
                .add("damaged", s.damaged)
                .add("network_failures", s.network_failures)
                .add("activations", s.activations)
                .add("commands_sent", s.commands_sent)
                .add("releases_sent", s.releases_sent)
                .add("latency_p50_ms", latency.quantile_ms(0.5))
                .add("latency_p95_ms", latency.quantile_ms(0.95))
                .add("latency_p99_ms", latency.quantile_ms(0.99))
                .add("latency_max_ms", latency.max_ms())
                .add("lost_lines", log.lost())
                .str());
}

}  // namespace

void check_config(const std::string& path) { check_files(load_config(path)); }

int fly(const std::string& config_path, bool dry_run) {
  FlightConfig config = load_config(config_path);
  check_files(config);
  config.loop.dry_run = dry_run;
  config.link.listen_only = dry_run;
  flight::slow_time(config.time_scale);
  const sigset_t ends = take_signals();
  write_from_a_thread();
  if (config.time_scale != 1.0) {
    spdlog::warn("the clock runs at {} of time: for simulations only", config.time_scale);
  }

  auto engine = std::make_shared<engine::FlowEngine>(engine::FlowEngine::load(config.model_path, config.engine));
  const auto& info = engine->info();
  cv::setNumThreads(std::max(config.engine.threads, 1));
  spdlog::info("model {} ({}, {} parameters, {} on {})", info.name, info.format, info.parameters, info.precision,
               info.device);
  const skills::InferFunction infer = [engine](const ImageView& a, const ImageView& b, FlowField& field,
                                               double time_s) { engine->infer_into(a, b, field, time_s); };
  engine->warm_up(config.loop.width, config.loop.height);
  flight::test_model(infer, config.loop.width, config.loop.height);
  spdlog::info("model self-test at {}x{}: passed", config.loop.width, config.loop.height);
  take_time(infer, config);

  auto log = std::make_unique<flight::FlightLog>(config.log);
  if (!config.log.folder.empty()) {
    spdlog::info("log: {}", log->path().string());
  }
  log_start(*log, config, info, dry_run);

  flight::LoopParts parts;
  // The first opening here, so that a wrong source is a wrong configuration; later ones in flight.
  auto first = std::make_shared<std::unique_ptr<flight::FrameSource>>(flight::open_source(config.source));
  parts.open_source = [first, options = config.source] {
    return *first ? std::move(*first) : flight::open_source(options);
  };
  parts.source_ends =
      config.source.kind == flight::SourceKind::kFolder || config.source.kind == flight::SourceKind::kVideo;
  parts.skill = skills::make_skill(config.skill, skills::network_signal(infer, config.skill.horizontal_fov_rad));
  parts.link = std::make_unique<flight::Link>(
      flight::make_transport(config.endpoint), config.link, config.output,
      config.signing_key_file.empty() ? std::nullopt : std::optional(load_signing_key(config.signing_key_file)));
  parts.output = config.output == flight::OutputKind::kRcOverride ? flight::make_rc_output(config.rc)
                                                                  : flight::make_attitude_output(config.attitude);
  parts.log = log.get();
  parts.say = say;
  auto loop = std::make_unique<flight::FlightLoop>(config.loop, std::move(parts));
  if (dry_run) {
    spdlog::warn("dry run: nothing will be sent");
  }
  loop->start();
  watch(*loop, ends, config.loop.safety.max_tick_s);

  const bool joined = loop->join(kJoin_s);
  report_end(*log, loop->statistics());
  if (log->failed()) {
    spdlog::warn("the log is incomplete: {} lines or frames could not be written (disk full?)", log->lost());
  }
  log->close();
  if (!joined) {
    spdlog::shutdown();
    // A driver or the network still holds a thread: nothing is left to be done for the vehicle, so go without it.
    std::_Exit(EXIT_SUCCESS);
  }
  return EXIT_SUCCESS;
}

}  // namespace ajna::apps
