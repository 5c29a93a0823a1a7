// SPDX-License-Identifier: MIT
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <optional>
#include <utility>

namespace ajna::flight {

/// A place for one value between two threads: the newest wins, what was not taken in time is dropped and counted. There
/// is no queue that could grow.
template <typename T>
class Latest {
 public:
  void put(T value) {
    {
      const std::lock_guard lock(mutex_);
      dropped_ += value_ ? 1 : 0;
      before_ = std::exchange(value_, std::move(value));
    }
    changed_.notify_one();
  }

  /// The newest value, once; waits up to `timeout_s` for one. before: the one that it overwrote, if there is one.
  std::optional<T> take(double timeout_s, std::optional<T>* before = nullptr) {
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, std::chrono::duration<double>(timeout_s), [this] { return value_.has_value(); });
    if (before != nullptr) {
      *before = std::exchange(before_, std::nullopt);
    }
    return std::exchange(value_, std::nullopt);
  }

  [[nodiscard]] std::uint64_t dropped() const {
    const std::lock_guard lock(mutex_);
    return dropped_;
  }

 private:
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::optional<T> value_;
  std::optional<T> before_;
  std::uint64_t dropped_ = 0;
};

}  // namespace ajna::flight
