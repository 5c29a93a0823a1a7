// SPDX-License-Identifier: MIT
#include "ajna/flight/emergency.hpp"

#include <unistd.h>

#include <array>
#include <atomic>
#include <cstring>

namespace ajna::flight {
namespace {

/// Two places, so that one is whole while the other is being written.
struct Slot {
  std::array<std::uint8_t, 512> bytes{};
  std::size_t size = 0;
  int descriptor = -1;
};
std::array<Slot, 2> slots;
std::atomic<int> current{-1};
static_assert(std::atomic<int>::is_always_lock_free, "read in signal handlers");

}  // namespace

void EmergencyRelease::arm(int descriptor, const std::uint8_t* data, std::size_t size) noexcept {
  const int next = current.load() == 0 ? 1 : 0;
  Slot& slot = slots[static_cast<std::size_t>(next)];
  if (descriptor < 0 || size > slot.bytes.size()) {
    disarm();
    return;
  }
  std::memcpy(slot.bytes.data(), data, size);
  slot.size = size;
  slot.descriptor = descriptor;
  current.store(next);
}

void EmergencyRelease::disarm() noexcept { current.store(-1); }

bool EmergencyRelease::armed() noexcept { return current.load() >= 0; }

void EmergencyRelease::fire() noexcept {
  const int index = current.load();
  if (index < 0) {
    return;
  }
  const Slot& slot = slots[static_cast<std::size_t>(index)];
  constexpr int kTimes = 3;
  for (int i = 0; i < kTimes; ++i) {
    [[maybe_unused]] const auto written = ::write(slot.descriptor, slot.bytes.data(), slot.size);
  }
}

}  // namespace ajna::flight
