// SPDX-License-Identifier: MIT
// Bytes from the autopilot's side of the link, whole frames and rubbish: parser, vehicle state, parameters, control
// loop. Whatever comes, nothing may be overridden: there is neither a camera nor a network.
#include <algorithm>
#include <memory>
#include <string>

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

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1 || size > 1 << 16) {
    return 0;
  }
  std::optional<SigningKey> key;
  if (data[0] % 4 == 0) {
    key = SigningKey{};
  }
  auto owned = std::make_unique<FuzzTransport>(data + 1, size - 1);
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
