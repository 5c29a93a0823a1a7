// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

namespace ajna::flight {

/// Where the autopilot is.
struct Endpoint {
  enum class Kind : std::uint8_t { kUdpListen, kUdpSend, kTcp, kSerial };
  Kind kind = Kind::kUdpListen;
  std::string host;    ///< UDP and TCP: numeric address or name
  std::string device;  ///< serial
  int port = 0;        ///< UDP and TCP
  int baud = 0;        ///< serial
  unsigned speed = 0;  ///< serial: the system's code for that rate
};

/// "udpin:0.0.0.0:14550" (wait for the autopilot), "udpout:127.0.0.1:14550", "tcp:127.0.0.1:5760" (connect to it) or
/// "serial:/dev/serial0:921600". Throws Error(kInvalidArgument).
Endpoint parse_endpoint(const std::string& text);

/// A byte pipe to the autopilot. Nothing blocks, nothing throws: what fails is closed, and opened again by service()
/// once a second. Not thread-safe.
class Transport {
 public:
  virtual ~Transport() = default;
  Transport() = default;
  Transport(const Transport&) = delete;
  Transport& operator=(const Transport&) = delete;

  /// Open what is closed. now_s: monotonic.
  virtual void service(double now_s) noexcept = 0;
  /// Bytes that have arrived, at most `size`; 0 where there are none.
  virtual std::size_t read(std::uint8_t* data, std::size_t size) noexcept = 0;
  /// All of `data`, or nothing of it and false: a frame is never cut, never kept for later.
  virtual bool write(const std::uint8_t* data, std::size_t size) noexcept = 0;
  [[nodiscard]] virtual bool is_open() const noexcept = 0;
  /// For writes from a signal handler; -1 where closed (or a peer is not known yet).
  [[nodiscard]] virtual int descriptor() const noexcept = 0;
  /// Why it is closed; empty where it is open.
  [[nodiscard]] virtual std::string problem() const = 0;
};

std::unique_ptr<Transport> make_transport(const Endpoint& endpoint);

}  // namespace ajna::flight
