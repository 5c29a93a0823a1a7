// SPDX-License-Identifier: MIT
#include "ajna/flight/flight_loop.hpp"

#include <sched.h>

#include <chrono>
#include <cmath>
#include <exception>
#include <optional>
#include <thread>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/flight/control_loop.hpp"
#include "ajna/flight/emergency.hpp"
#include "ajna/flight/json_line.hpp"
#include "ajna/flight/latest.hpp"
#include "ajna/flight/perceived.hpp"
#include "ajna/io/image_io.hpp"

namespace ajna::flight {
namespace {

constexpr double kReopen_s = 1.0;
constexpr double kWait_s = 0.05;

void sleep_for(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

/// Bind this thread; false where the system refuses.
bool bind_to(const std::vector<int>& cpus) {
  if (cpus.empty()) {
    return true;
  }
  cpu_set_t set;
  CPU_ZERO(&set);
  for (const int cpu : cpus) {
    CPU_SET(static_cast<std::size_t>(cpu), &set);
  }
  return ::sched_setaffinity(0, sizeof(set), &set) == 0;
}

void require(bool valid, const char* what) {
  if (!valid) {
    throw_invalid(what);
  }
}

}  // namespace

void validate(const LoopOptions& options) {
  validate(options.safety);
  require(!options.allowed_modes.empty(), "safety.allowed_modes: give at least one flight mode");
  require(options.switch_channel >= 1 && options.switch_channel <= kRcChannels, "safety.switch_channel: give 1 to 18");
  require(options.width >= 16 && options.width <= 4096 && options.height >= 16 && options.height <= 4096,
          "network.width_px and height_px: give 16 to 4096");
  require(options.deadline_s >= 0.01 && options.deadline_s <= 1.0, "network.deadline_s: give 0.01 to 1");
  require(options.camera_pitch_rad >= -1.5 && options.camera_pitch_rad <= 1.5,
          "task.camera_pitch_rad: give -1.5 to 1.5");
  require(options.max_damaged_frames >= 1 && options.max_damaged_frames <= 100, "max_damaged_frames: give 1 to 100");
  require(options.tick_s >= 0.002 && options.tick_s <= 0.04, "tick_s: give 0.002 to 0.04");
  require(options.command_every_s >= 0.01 && options.command_every_s <= 0.1, "command_every_s: give 0.01 to 0.1");
  for (const auto* cpus : {&options.perception_cpus, &options.control_cpus}) {
    for (const int cpu : *cpus) {
      require(cpu >= 0 && cpu < CPU_SETSIZE, "threads: give CPU numbers from 0 on");
    }
  }
}

struct FlightLoop::Impl {
  LoopOptions options;
  LoopParts parts;
  Blackboard board;
  Latest<CapturedFrame> newest;
  ControlLoop control;
  std::atomic<double> last_tick_s{0.0};
  std::atomic<std::uint64_t> frames{0}, stale{0}, damaged{0}, network_failures{0};
  std::atomic<bool> capture_ended{true}, perception_ended{true}, control_ended{true};
  double began_s = 0.0;
  std::thread capture_thread, perception_thread, control_thread;

  Impl(const LoopOptions& loop_options, LoopParts loop_parts)
      : options(loop_options),
        parts(std::move(loop_parts)),
        control(options, *parts.link, *parts.output, board, parts.log, parts.say) {}

  void event(Level level, const std::string& text) const {
    parts.say(level, text);
    if (parts.log != nullptr) {
      parts.log->write(JsonLine().add("type", "event").add("time_s", monotonic_s() - began_s).add("text", text).str());
    }
  }

  // --- capture ---

  /// Frames until the source ends or fails.
  void capture_from(FrameSource& source) {
    int damaged_in_a_row = 0;
    while (!board.ended.load()) {
      SourceResult result = source.next();
      switch (result.kind) {
        case SourceResult::Kind::kFrame:
          damaged_in_a_row = 0;
          ++frames;
          board.frame_came(result.frame.captured_s);
          newest.put(std::move(result.frame));
          break;
        case SourceResult::Kind::kDamaged:
          ++damaged;
          event(Level::kWarning, "damaged frame: " + result.problem);
          if (++damaged_in_a_row >= options.max_damaged_frames) {
            board.camera_failed();
          }
          break;
        case SourceResult::Kind::kEnd:
          return;
        case SourceResult::Kind::kNothing:
          break;
      }
    }
  }

  void capture() {
    while (!board.ended.load()) {
      try {
        const auto source = parts.open_source();
        capture_from(*source);
        if (parts.source_ends && !board.ended.load()) {
          event(Level::kInfo, "the recording has ended");
          board.stop = true;
          return;
        }
      } catch (const std::exception& error) {
        event(Level::kError, std::string("source: ") + error.what());
      }
      board.camera_failed();
      for (double left_s = kReopen_s; left_s > 0.0 && !board.ended.load(); left_s -= kWait_s) {
        sleep_for(kWait_s);
      }
    }
  }

  // --- perception ---

  void perceive() {
    if (!bind_to(options.perception_cpus)) {
      event(Level::kWarning, "threads.perception_cpus: the system refuses them");
    }
    std::uint64_t activation = 0;
    while (!board.ended.load()) {
      std::optional<CapturedFrame> before;
      const auto frame = newest.take(kWait_s, &before);
      if (!frame) {
        continue;
      }
      if (monotonic_s() - frame->captured_s > options.deadline_s) {
        ++stale;
        continue;
      }
      try {
        if (before) {
          parts.skill->remember(Prepared(*before, *this).input);
        }
        step(*frame, activation);
      } catch (const std::exception& error) {
        // The next frame may do; until then nothing of this one is used.
        board.network_failed();
        ++network_failures;
        event(Level::kError, std::string("perception: ") + error.what());
      }
    }
  }

  /// A frame as the skill takes it, with what the autopilot said of that time.
  struct Prepared {
    Image resized;
    skills::SkillInput input;

    Prepared(const CapturedFrame& frame, const Impl& flight) {
      const LoopOptions& wanted = flight.options;
      const bool fits = frame.image.width() == wanted.width && frame.image.height() == wanted.height;
      if (!fits) {
        resized = io::resize_image(frame.image.view(), wanted.width, wanted.height);
      }
      input.frame = fits ? frame.image.view() : resized.view();
      input.captured_s = frame.captured_s;
      input.velocity_m_s = flight.board.motion().velocity_m_s;
      if (wanted.use_attitude) {
        input.attitude = flight.board.attitudes.at(frame.captured_s, wanted.camera_pitch_rad);
      }
    }
    Prepared(const Prepared&) = delete;
    Prepared& operator=(const Prepared&) = delete;
  };

  void step(const CapturedFrame& frame, std::uint64_t& activation) {
    const double began = monotonic_s();
    const Prepared prepared(frame, *this);
    if (const auto now = board.activations.load(); now != activation) {
      activation = now;
      parts.skill->begin();
    }
    const skills::SkillOutput output = parts.skill->plan(prepared.input);
    if (output.valid) {
      board.command_made(output.command, frame.captured_s);
    }
    log_frame(frame, output, monotonic_s() - began);
  }

  void log_frame(const CapturedFrame& frame, const skills::SkillOutput& output, double duration_s) const {
    if (parts.log == nullptr) {
      return;
    }
    JsonLine line;
    line.add("type", "frame")
        .add("time_s", frame.captured_s - began_s)
        .add("index", frame.index)
        .add("name", frame.name)
        .add("status", output.status)
        .add("perception_ms", duration_s * 1e3)
        .add("latency_ms", (monotonic_s() - frame.captured_s) * 1e3)
        .add("command", control::to_string(output.command.mode))
        .add("velocity_m_s", std::vector<double>{output.command.velocity_m_s.x(), output.command.velocity_m_s.y(),
                                                 output.command.velocity_m_s.z()})
        .add("yaw_rate_rad_s", output.command.yaw_rate_rad_s);
    if (output.flow) {
      line.add("mean_flow_px", output.flow->mean_flow_px)
          .add("max_flow_px", output.flow->max_flow_px)
          .add("mean_uncertainty", output.flow->mean_uncertainty)
          .add("mean_expected_error_px", output.flow->mean_expected_error_px);
    }
    parts.log->write(line.str());
    parts.log->write_frame(frame.image, frame.index);
  }

  // --- control ---

  void run_control() {
    if (!bind_to(options.control_cpus)) {
      event(Level::kWarning, "threads.control_cpus: the system refuses them");
    }
    double next_s = monotonic_s();
    while (!control.done()) {
      const double now_s = monotonic_s();
      last_tick_s = now_s;
      try {
        control.tick(now_s);
      } catch (const std::exception& error) {
        EmergencyRelease::fire();
        board.internal_error = true;
        event(Level::kError, std::string("control: ") + error.what());
      }
      next_s = std::max(next_s + options.tick_s, now_s);
      sleep_for(std::max(0.0, std::min(next_s - monotonic_s(), options.tick_s)));
    }
    board.ended = true;
  }

  /// Run a thread's function; whatever escapes it ends the flight, not the process.
  template <typename Function>
  std::thread launch(std::atomic<bool>& ended, const char* name, Function function) {
    ended = false;
    return std::thread([this, &ended, name, function] {
      try {
        function();
      } catch (const std::exception& error) {
        board.internal_error = true;
        parts.say(Level::kError, std::string("the ") + name + " thread has failed: " + error.what());
      } catch (...) {  // a driver may throw anything: it is released all the same
        board.internal_error = true;
        parts.say(Level::kError, std::string("the ") + name + " thread has failed");
      }
      ended = true;
    });
  }
};

FlightLoop::FlightLoop(const LoopOptions& options, LoopParts parts) {
  validate(options);
  if (parts.output->uses_channel(options.switch_channel)) {
    throw_invalid("safety.switch_channel " + std::to_string(options.switch_channel) +
                  " is overridden by an axis of rc: the pilot's switch must stay the pilot's");
  }
  impl_ = std::make_unique<Impl>(options, std::move(parts));
}

FlightLoop::~FlightLoop() {
  if (impl_) {
    request_stop();
    for (auto* thread : {&impl_->control_thread, &impl_->perception_thread, &impl_->capture_thread}) {
      if (thread->joinable()) {
        thread->join();
      }
    }
  }
}

void FlightLoop::start() {
  Impl& impl = *impl_;
  impl.began_s = monotonic_s();
  impl.last_tick_s = impl.began_s;
  impl.control_thread = impl.launch(impl.control_ended, "control", [&impl] { impl.run_control(); });
  impl.perception_thread = impl.launch(impl.perception_ended, "perception", [&impl] { impl.perceive(); });
  impl.capture_thread = impl.launch(impl.capture_ended, "capture", [&impl] { impl.capture(); });
}

void FlightLoop::request_stop() noexcept { impl_->board.stop = true; }

bool FlightLoop::finished() const noexcept { return impl_->control_ended.load(); }

double FlightLoop::last_tick_s() const noexcept { return impl_->last_tick_s.load(); }

bool FlightLoop::join(double timeout_s) {
  const double until_s = monotonic_s() + timeout_s;
  Impl& impl = *impl_;
  const auto ended = [&impl] {
    return impl.control_ended.load() && impl.perception_ended.load() && impl.capture_ended.load();
  };
  while (!ended()) {
    if (monotonic_s() > until_s) {
      return false;
    }
    sleep_for(0.005);
  }
  for (auto* thread : {&impl.control_thread, &impl.perception_thread, &impl.capture_thread}) {
    if (thread->joinable()) {
      thread->join();
    }
  }
  return true;
}

LoopStatistics FlightLoop::statistics() const {
  LoopStatistics statistics;
  const Impl& impl = *impl_;
  statistics.frames = impl.frames.load();
  statistics.dropped = impl.newest.dropped();
  statistics.stale = impl.stale.load();
  statistics.damaged = impl.damaged.load();
  statistics.network_failures = impl.network_failures.load();
  statistics.activations = impl.board.activations.load();
  if (impl.control_ended.load()) {
    statistics.commands_sent = impl.control.commands_sent();
    statistics.releases_sent = impl.control.releases_sent();
    statistics.capture_to_command = impl.control.latency();
  }
  return statistics;
}

}  // namespace ajna::flight
