// SPDX-License-Identifier: MIT
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include "ajna/base/image_view.hpp"

namespace ajna::flight {

struct LogOptions {
  std::string folder;                              ///< empty: no log; every flight gets a file of its own in it
  int frame_every = 0;                             ///< write each n-th frame as JPEG beside the log; 0: none
  std::int64_t max_bytes = std::int64_t{2} << 30;  ///< of the log with its frames; then it ends, the flight goes on
};

/// The flight log: one JSON object a line, written by a thread of its own. Writers never wait and never fail: what
/// finds the queue full, or the disk, is counted and left out.
class FlightLog {
 public:
  /// Opens "flight-0001.jsonl" (the next free number) in the folder, which is made if it is missing.
  /// Throws Error(kRuntime) where that cannot be done: a flight that cannot be logged is not begun.
  explicit FlightLog(const LogOptions& options);
  ~FlightLog();
  FlightLog(const FlightLog&) = delete;
  FlightLog& operator=(const FlightLog&) = delete;

  /// Queue a line (without its line break).
  void write(std::string line) noexcept;
  /// Queue a frame, where `index` is one that is to be kept.
  void write_frame(const Image& image, std::int64_t index) noexcept;
  /// Write what is queued and close; called by the destructor.
  void close() noexcept;

  [[nodiscard]] const std::filesystem::path& path() const noexcept { return path_; }
  [[nodiscard]] std::uint64_t lost() const noexcept { return lost_.load(); }  ///< lines and frames left out
  [[nodiscard]] bool failed() const noexcept { return failed_.load(); }       ///< the disk refused something

 private:
  struct Item {
    std::string line;
    Image frame;
    std::int64_t index = 0;
  };
  void run() noexcept;
  void put(const Item& item);

  LogOptions options_;
  std::filesystem::path path_;
  int descriptor_ = -1;
  std::int64_t written_ = 0;
  std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<Item> queue_;
  std::size_t frames_queued_ = 0;
  bool closing_ = false;
  std::atomic<std::uint64_t> lost_{0};
  std::atomic<bool> failed_{false};
  std::thread thread_;
};

}  // namespace ajna::flight
