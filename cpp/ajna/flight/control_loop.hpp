// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <memory>
#include <optional>

#include "ajna/flight/echo_check.hpp"
#include "ajna/flight/flight_loop.hpp"
#include "ajna/flight/perceived.hpp"

namespace ajna::flight {

/// One tick after another of the link and the safety machine; the time is given, so that tests can run it faster than
/// time. Private to flight_loop.cpp and the tests.
class ControlLoop {
 public:
  ControlLoop(const LoopOptions& options, Link& link, CommandOutput& output, Blackboard& board, FlightLog* log,
              Say say);

  /// Everything of one tick: read, decide, send, log.
  SafetyDecision tick(double now_s);
  /// Whether the program may end: it was asked to, and nothing is held any more.
  [[nodiscard]] bool done() const noexcept;

  [[nodiscard]] std::uint64_t commands_sent() const noexcept { return commands_sent_; }
  [[nodiscard]] std::uint64_t releases_sent() const noexcept { return releases_sent_; }
  [[nodiscard]] const LatencyHistogram& latency() const noexcept { return latency_; }

 private:
  [[nodiscard]] SafetyInputs inputs(double now_s, const Perceived& perceived) const;
  void send_command(double now_s, const Perceived& perceived);
  void send_release(double now_s);
  void report(double now_s, const SafetyDecision& decision);
  void log_state(double now_s, const SafetyDecision& decision, const Perceived& perceived);
  [[nodiscard]] std::uint32_t boot_ms(double now_s) const;

  LoopOptions options_;
  Link& link_;
  CommandOutput& output_;
  Blackboard& board_;
  FlightLog* log_;
  Say say_;
  SafetyMachine safety_;
  EchoCheck echo_;
  LatencyHistogram latency_;
  std::optional<double> began_s_;
  std::optional<double> sent_s_;  ///< last command
  std::optional<double> logged_s_;
  std::optional<double> rc_seen_s_;
  std::optional<Fault> reported_;
  std::string objection_;
  std::uint64_t last_command_ = 0;
  std::uint64_t old_command_ = 0;  ///< the newest one at the activation
  std::uint64_t latency_command_ = 0;
  std::uint64_t commands_sent_ = 0;
  std::uint64_t releases_sent_ = 0;
  int failed_writes_ = 0;
  bool release_failed_ = false;  ///< the last one, of those that are being sent
  bool command_valid_ = true;
};

}  // namespace ajna::flight
