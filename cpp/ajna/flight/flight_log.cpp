// SPDX-License-Identifier: MIT
#include "ajna/flight/flight_log.hpp"

#include <fcntl.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <system_error>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/io/image_io.hpp"

namespace ajna::flight {
namespace fs = std::filesystem;
namespace {

constexpr std::size_t kQueue = 4096;
constexpr std::size_t kFrameQueue = 8;
constexpr int kMaxFlights = 9999;

std::string name_of(const char* pattern, long long number) {
  std::array<char, 64> buffer{};
  std::snprintf(buffer.data(), buffer.size(), pattern, number);
  return buffer.data();
}

}  // namespace

FlightLog::FlightLog(const LogOptions& options) : options_(options) {
  if (options.folder.empty()) {
    return;
  }
  const fs::path folder = options.folder;
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) {
    throw_runtime("log folder '" + folder.string() + "' cannot be made (" + error.message() +
                  "): give another log.folder");
  }
  for (int i = 1; i <= kMaxFlights && descriptor_ < 0; ++i) {
    path_ = folder / name_of("flight-%04lld.jsonl", i);
    descriptor_ = ::open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_APPEND | O_CLOEXEC, 0644);
    if (descriptor_ < 0 && errno != EEXIST) {
      throw_runtime("log file '" + path_.string() + "' cannot be made (" + std::strerror(errno) +
                    "): free the disk or give another log.folder");
    }
  }
  if (descriptor_ < 0) {
    throw_runtime("log folder '" + folder.string() + "' is full of flights: move them away");
  }
  if (options_.frame_every > 0) {
    fs::create_directories(path_.parent_path() / path_.stem(), error);
  }
  thread_ = std::thread([this] { run(); });
}

FlightLog::~FlightLog() { close(); }

void FlightLog::write(std::string line) noexcept {
  if (descriptor_ < 0) {
    return;
  }
  try {
    const std::lock_guard lock(mutex_);
    if (queue_.size() >= kQueue || closing_) {
      ++lost_;
      return;
    }
    queue_.push_back({std::move(line), {}, 0});
  } catch (...) {  // out of memory: a lost line is counted, the flight goes on
    ++lost_;
  }
  changed_.notify_one();
}

void FlightLog::write_frame(const Image& image, std::int64_t index) noexcept {
  if (descriptor_ < 0 || options_.frame_every <= 0 || index % options_.frame_every != 0) {
    return;
  }
  try {
    Image copy = image;  // outside of the lock
    const std::lock_guard lock(mutex_);
    if (frames_queued_ >= kFrameQueue || closing_) {
      ++lost_;
      return;
    }
    queue_.push_back({{}, std::move(copy), index});
    ++frames_queued_;
  } catch (...) {  // out of memory: a lost frame is counted, the flight goes on
    ++lost_;
  }
  changed_.notify_one();
}

void FlightLog::close() noexcept {
  if (!thread_.joinable()) {
    return;
  }
  {
    const std::lock_guard lock(mutex_);
    closing_ = true;
  }
  changed_.notify_one();
  thread_.join();
  ::close(descriptor_);
  descriptor_ = -1;
}

void FlightLog::put(const Item& item) {
  if (written_ >= options_.max_bytes) {
    ++lost_;
    return;
  }
  if (!item.frame.empty()) {
    io::write_image(path_.parent_path() / path_.stem() / name_of("%06lld.jpg", item.index), item.frame.view());
    written_ += static_cast<std::int64_t>(item.frame.size_bytes() / 10);  // about what JPEG makes of it
    return;
  }
  const std::string line = item.line + "\n";
  std::size_t done = 0;
  while (done < line.size()) {
    const ssize_t count = ::write(descriptor_, line.data() + done, line.size() - done);
    if (count < 0 && errno == EINTR) {
      continue;
    }
    if (count <= 0) {
      // A line cut short is ended by the next one that fits; readers skip it.
      failed_ = true;
      ++lost_;
      return;
    }
    done += static_cast<std::size_t>(count);
  }
  written_ += static_cast<std::int64_t>(line.size());
}

void FlightLog::run() noexcept {
  for (;;) {
    Item item;
    {
      std::unique_lock lock(mutex_);
      changed_.wait(lock, [this] { return closing_ || !queue_.empty(); });
      if (queue_.empty()) {
        return;
      }
      item = std::move(queue_.front());
      queue_.pop_front();
      frames_queued_ -= item.frame.empty() ? 0 : 1;
    }
    try {
      put(item);
    } catch (...) {  // the disk, or memory: the flight goes on
      failed_ = true;
      ++lost_;
    }
  }
}

}  // namespace ajna::flight
