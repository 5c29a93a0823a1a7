// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>

namespace ajna::flight {

/// The release as ready-made bytes, for when the program can no longer be trusted to make them: a crash (signal
/// handlers may call fire) or a control loop that stands still. One per process.
class EmergencyRelease {
 public:
  /// From now on fire() writes these bytes to this descriptor. Called at every tick that sends a command, by one
  /// thread.
  static void arm(int descriptor, const std::uint8_t* data, std::size_t size) noexcept;
  /// From now on fire() does nothing: the release has gone out the ordinary way.
  static void disarm() noexcept;
  /// Write the release, if armed, several times. Async-signal-safe; from any thread.
  static void fire() noexcept;
  [[nodiscard]] static bool armed() noexcept;
};

}  // namespace ajna::flight
