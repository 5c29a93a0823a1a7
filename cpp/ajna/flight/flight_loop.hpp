// SPDX-License-Identifier: MIT
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "ajna/flight/command_output.hpp"
#include "ajna/flight/flight_log.hpp"
#include "ajna/flight/latency.hpp"
#include "ajna/flight/link.hpp"
#include "ajna/flight/safety.hpp"
#include "ajna/flight/source.hpp"
#include "ajna/skills/skill.hpp"

namespace ajna::flight {

struct LoopOptions {
  SafetyOptions safety;
  std::vector<std::uint32_t> allowed_modes;  ///< custom modes in which commands may be sent
  int switch_channel = 8;                    ///< the pilot's switch, 1 to 18
  int width = 320;                           ///< of the network's frames, pixels
  int height = 240;
  double deadline_s = 0.1;           ///< a frame older than this is not looked at any more
  bool use_attitude = true;          ///< take the vehicle's turning and tilt out of what is seen
  double camera_pitch_rad = 0.0;     ///< of the camera, up from the body's forward axis
  int max_damaged_frames = 3;        ///< so many in a row count as no camera
  double tick_s = 0.01;              ///< of the control loop
  double command_every_s = 0.04;     ///< a command is sent again at least so often
  bool dry_run = false;              ///< send nothing; parameters and echo are then not looked at
  std::vector<int> perception_cpus;  ///< empty: any
  std::vector<int> control_cpus;
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const LoopOptions& options);

enum class Level : std::uint8_t { kInfo, kWarning, kError };
using Say = std::function<void(Level, const std::string&)>;

/// What a flight is made of.
struct LoopParts {
  std::function<std::unique_ptr<FrameSource>()> open_source;  ///< again after a camera has failed
  bool source_ends = false;                                   ///< recorded: the program ends with it
  std::unique_ptr<skills::Skill> skill;                       ///< its network has passed its self-test
  std::unique_ptr<Link> link;
  std::unique_ptr<CommandOutput> output;
  FlightLog* log = nullptr;
  Say say;  ///< from any thread
};

struct LoopStatistics {
  std::uint64_t frames = 0;   ///< good ones that came
  std::uint64_t dropped = 0;  ///< overwritten by a newer one before they were looked at
  std::uint64_t stale = 0;    ///< too old when their turn came
  std::uint64_t damaged = 0;
  std::uint64_t network_failures = 0;
  std::uint64_t commands_sent = 0;
  std::uint64_t releases_sent = 0;
  std::uint64_t activations = 0;
  LatencyHistogram capture_to_command;  ///< from capture until the control loop had the command
};

/// Three threads with nothing between them that could queue: capture (which may block in a driver), perception (network
/// and policy) and control (link and safety). The control thread depends on neither of the others: it only looks at how
/// old what they left is.
class FlightLoop {
 public:
  /// Throws Error(kInvalidArgument) for options out of range and for a switch channel that the output overrides.
  FlightLoop(const LoopOptions& options, LoopParts parts);
  ~FlightLoop();
  FlightLoop(const FlightLoop&) = delete;
  FlightLoop& operator=(const FlightLoop&) = delete;

  void start();
  /// Release what is held, then end. Async-signal-safe.
  void request_stop() noexcept;
  /// The control thread has released everything and ended.
  [[nodiscard]] bool finished() const noexcept;
  /// monotonic_s() of the control thread's last tick: another thread must see to it that this advances.
  [[nodiscard]] double last_tick_s() const noexcept;
  /// Wait for all threads; false where one still hangs in a driver or a network: then only the process can end it.
  bool join(double timeout_s);
  [[nodiscard]] LoopStatistics statistics() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace ajna::flight
