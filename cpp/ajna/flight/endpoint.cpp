// SPDX-License-Identifier: MIT
#include <termios.h>

#include <array>
#include <charconv>
#include <system_error>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/flight/transport.hpp"

namespace ajna::flight {
namespace {

constexpr std::array<std::pair<int, speed_t>, 9> kBaudRates = {{{9600, B9600},
                                                                {19200, B19200},
                                                                {38400, B38400},
                                                                {57600, B57600},
                                                                {115200, B115200},
                                                                {230400, B230400},
                                                                {460800, B460800},
                                                                {921600, B921600},
                                                                {1500000, B1500000}}};

int number(const std::string& text, int low, int high, const std::string& whole) {
  int value = 0;
  const auto [end, failure] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (failure != std::errc() || end != text.data() + text.size() || value < low || value > high) {
    throw_invalid("endpoint '" + whole + "': '" + text + "' is no number from " + std::to_string(low) + " to " +
                  std::to_string(high));
  }
  return value;
}

}  // namespace

Endpoint parse_endpoint(const std::string& text) {
  const std::size_t first = text.find(':');
  const std::size_t last = text.rfind(':');
  if (first == std::string::npos || last == first || last - first < 2) {
    throw_invalid("endpoint '" + text +
                  "': give udpin:ADDRESS:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD");
  }
  const std::string kind = text.substr(0, first);
  const std::string middle = text.substr(first + 1, last - first - 1);
  const std::string end = text.substr(last + 1);
  Endpoint endpoint;
  if (kind == "serial") {
    endpoint.kind = Endpoint::Kind::kSerial;
    endpoint.device = middle;
    endpoint.baud = number(end, 1, 100000000, text);
    std::string known;
    for (const auto& [baud, speed] : kBaudRates) {
      known += (known.empty() ? "" : ", ") + std::to_string(baud);
      if (baud == endpoint.baud) {
        endpoint.speed = speed;
        return endpoint;
      }
    }
    throw_invalid("endpoint '" + text + "': baud rate " + end + " is not one of " + known);
  }
  endpoint.host = middle;
  endpoint.port = number(end, 1, 65535, text);
  if (kind == "udpin") {
    endpoint.kind = Endpoint::Kind::kUdpListen;
  } else if (kind == "udpout") {
    endpoint.kind = Endpoint::Kind::kUdpSend;
  } else if (kind == "tcp") {
    endpoint.kind = Endpoint::Kind::kTcp;
  } else {
    throw_unknown("kind of endpoint", kind, {"udpin", "udpout", "tcp", "serial"});
  }
  return endpoint;
}

}  // namespace ajna::flight
