// SPDX-License-Identifier: MIT
// Bytes from the autopilot's side of the link: parser, vehicle state, parameters, control loop. Either as they are, or
// as payloads of frames with a right checksum, which chance would not find. Whatever comes, nothing may be overridden:
// there is neither a camera nor a network.
#include <algorithm>
#include <array>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "ajna/flight/control_loop.hpp"

namespace {

using namespace ajna::flight;

class FuzzTransport final : public Transport {
 public:
  FuzzTransport(const std::uint8_t* data, std::size_t size) : data_(data), left_(size) {}
  void service(double /*now_s*/) noexcept override { budget_ = 64; }
  std::size_t read(std::uint8_t* data, std::size_t size) noexcept override {
    const std::size_t count = std::min({size, left_, budget_});
    std::copy_n(data_, count, data);
    data_ += count;
    left_ -= count;
    budget_ -= count;
    return count;
  }
  bool write(const std::uint8_t* data, std::size_t size) noexcept override {
    // Message id 70 is RC_CHANNELS_OVERRIDE, in bytes 7 to 9 of a MAVLink 2 frame.
    if (size > 9 && data[7] == 70 && data[8] == 0 && data[9] == 0) {
      __builtin_trap();
    }
    return true;
  }
  [[nodiscard]] bool is_open() const noexcept override { return true; }
  [[nodiscard]] int descriptor() const noexcept override { return -1; }
  [[nodiscard]] std::string problem() const override { return {}; }
  [[nodiscard]] bool done() const { return left_ == 0; }

 private:
  const std::uint8_t* data_;
  std::size_t left_;
  std::size_t budget_ = 0;
};

/// Messages that the link reads, and the byte that each adds to its checksum (CRC_EXTRA of the official XML):
/// HEARTBEAT, SYS_STATUS, PARAM_VALUE, ATTITUDE, LOCAL_POSITION_NED, RC_CHANNELS, COMMAND_ACK, STATUSTEXT.
constexpr std::array<std::pair<std::uint8_t, std::uint8_t>, 8> kMessages{
    {{0, 50}, {1, 124}, {22, 220}, {30, 39}, {32, 185}, {65, 118}, {77, 143}, {253, 83}}};

/// The checksum of MAVLink: CRC-16/MCRF4XX.
std::uint16_t checksum(const std::vector<std::uint8_t>& bytes, std::uint8_t extra) {
  std::uint16_t crc = 0xFFFF;
  const auto add = [&crc](std::uint8_t byte) {
    auto t = static_cast<std::uint8_t>(byte ^ static_cast<std::uint8_t>(crc & 0xFF));
    t = static_cast<std::uint8_t>(t ^ (t << 4));
    crc = static_cast<std::uint16_t>((crc >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4));
  };
  std::for_each(bytes.begin() + 1, bytes.end(), add);
  add(extra);
  return crc;
}

/// [kind, length, payload ...] again and again, as MAVLink 2 frames of the vehicle.
std::vector<std::uint8_t> frames(const std::uint8_t* data, std::size_t size) {
  std::vector<std::uint8_t> wire;
  for (std::size_t at = 0; at + 2 <= size;) {
    const auto [id, extra] = kMessages[data[at] % kMessages.size()];
    const std::size_t length = std::min<std::size_t>(data[at + 1], size - at - 2);
    std::vector<std::uint8_t> frame{0xFD, static_cast<std::uint8_t>(length), 0, 0, 0, 1, 1, id, 0, 0};
    frame.insert(frame.end(), data + at + 2, data + at + 2 + length);
    const auto crc = checksum(frame, extra);
    frame.insert(frame.end(), {static_cast<std::uint8_t>(crc & 0xFF), static_cast<std::uint8_t>(crc >> 8)});
    wire.insert(wire.end(), frame.begin(), frame.end());
    at += 2 + length;
  }
  return wire;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1 || size > 1 << 16) {
    return 0;
  }
  std::optional<SigningKey> key;
  if (data[0] % 4 == 0) {
    key = SigningKey{};
  }
  const bool framed = (data[0] & 4U) != 0;
  const auto wire = framed ? frames(data + 1, size - 1) : std::vector<std::uint8_t>(data + 1, data + size);
  auto owned = std::make_unique<FuzzTransport>(wire.data(), wire.size());
  const FuzzTransport& transport = *owned;
  Link link(std::move(owned), {}, data[0] % 2 == 0 ? OutputKind::kRcOverride : OutputKind::kAttitude, key);
  const auto output = make_rc_output({});
  Blackboard board;
  LoopOptions options;
  options.allowed_modes = {5};
  ControlLoop loop(options, link, *output, board, nullptr, [](Level, const std::string&) {});
  for (double now_s = 0.0; !transport.done(); now_s += 0.01) {
    loop.tick(now_s);
  }
  return 0;
}
