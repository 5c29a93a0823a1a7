// SPDX-License-Identifier: MIT
#pragma once

#include <atomic>
#include <cstdint>
#include <mutex>
#include <optional>

#include "ajna/control/command.hpp"
#include "ajna/flight/attitude_history.hpp"
#include "ajna/flight/link.hpp"

namespace ajna::flight {

/// What perception has come to so far.
struct Perceived {
  std::optional<double> frame_s;          ///< capture of the newest good frame
  bool network_ok = false;                ///< the last inference succeeded
  std::optional<double> command_frame_s;  ///< capture of the frame behind `command`
  control::Command command;
  std::uint64_t commands = 0;  ///< how many there have been
};

/// All that the threads of a flight tell each other: each field is small, and locked only while it is copied.
class Blackboard {
 public:
  [[nodiscard]] Perceived perceived() const {
    const std::lock_guard lock(mutex_);
    return perceived_;
  }
  void frame_came(double captured_s) {
    const std::lock_guard lock(mutex_);
    perceived_.frame_s = captured_s;
  }
  void camera_failed() {
    const std::lock_guard lock(mutex_);
    perceived_.frame_s.reset();
  }
  void network_failed() {
    const std::lock_guard lock(mutex_);
    perceived_.network_ok = false;
    perceived_.command_frame_s.reset();
  }
  void command_made(const control::Command& command, double captured_s) {
    const std::lock_guard lock(mutex_);
    perceived_.network_ok = true;
    perceived_.command = command;
    perceived_.command_frame_s = captured_s;
    ++perceived_.commands;
  }

  [[nodiscard]] VehicleMotion motion() const {
    const std::lock_guard lock(mutex_);
    return motion_;
  }
  void vehicle_moved(const VehicleMotion& motion) {
    const std::lock_guard lock(mutex_);
    motion_ = motion;
  }

  AttitudeHistory attitudes;                  ///< locks itself
  std::atomic<std::uint64_t> activations{0};  ///< perception begins anew when this changes
  std::atomic<bool> stop{false};              ///< asked for
  std::atomic<bool> internal_error{false};    ///< a thread has failed for good
  std::atomic<bool> ended{false};             ///< the control loop is done: the others may go

 private:
  mutable std::mutex mutex_;
  Perceived perceived_;
  VehicleMotion motion_;
};

}  // namespace ajna::flight
