// SPDX-License-Identifier: MIT
// The whole loop with its threads: a camera, a network and an autopilot that the test decides about.
#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iterator>
#include <memory>
#include <new>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/flight/flight_loop.hpp"
#include "ajna/flight/self_test.hpp"
#include "flight_fixtures.hpp"
#include "io_files.hpp"

namespace ajna::flight {
namespace {

namespace fs = std::filesystem;

LoopOptions loop_options() {
  LoopOptions options;
  options.allowed_modes = {COPTER_MODE_LOITER};
  options.width = 32;
  options.height = 24;
  return options;
}

/// Frames at 100 Hz of which the test decides everything.
class TestSource final : public FrameSource {
 public:
  struct Control {
    std::atomic<bool> stalled{false}, damaged{false}, ended{false};
    std::atomic<int> opened{0};
  };
  explicit TestSource(std::shared_ptr<Control> control) : control_(std::move(control)) { ++control_->opened; }
  SourceResult next() override {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
    SourceResult result;
    if (control_->ended) {
      result.kind = SourceResult::Kind::kEnd;
    } else if (control_->damaged) {
      result.kind = SourceResult::Kind::kDamaged;
      result.problem = "a test's";
    } else if (!control_->stalled) {
      result.kind = SourceResult::Kind::kFrame;
      result.frame = {test_frame(32, 24, 1, static_cast<int>(index_), 0), monotonic_s(), index_, "test"};
      ++index_;
    }
    return result;
  }

 private:
  std::shared_ptr<Control> control_;
  std::int64_t index_ = 0;
};

/// A transport that runs the simulated autopilot whenever it is serviced.
class AutopilotTransport final : public Transport {
 public:
  struct Shared {
    SimulatedAutopilot autopilot;
    std::atomic<int> switch_us{1000};
    std::atomic<int> overridden_us{0};
  };
  explicit AutopilotTransport(std::shared_ptr<Shared> shared) : shared_(std::move(shared)) {}
  void service(double now_s) noexcept override {
    shared_->autopilot.switch_us = shared_->switch_us;
    shared_->autopilot.run(now_s, pipe_);
    shared_->overridden_us = shared_->autopilot.overridden()[0];
  }
  std::size_t read(std::uint8_t* data, std::size_t size) noexcept override { return pipe_.read(data, size); }
  bool write(const std::uint8_t* data, std::size_t size) noexcept override { return pipe_.write(data, size); }
  [[nodiscard]] bool is_open() const noexcept override { return true; }
  [[nodiscard]] int descriptor() const noexcept override { return -1; }
  [[nodiscard]] std::string problem() const override { return {}; }

 private:
  std::shared_ptr<Shared> shared_;
  MemoryTransport pipe_;
};

class FlightLoopTest : public ::testing::Test {
 protected:
  std::shared_ptr<TestSource::Control> camera = std::make_shared<TestSource::Control>();
  std::shared_ptr<AutopilotTransport::Shared> vehicle = std::make_shared<AutopilotTransport::Shared>();
  std::atomic<int> infer_ms{1};
  std::atomic<bool> infer_fails{false}, infer_throws{false};
  std::unique_ptr<FlightLoop> loop;

  void start(FlightLog* log = nullptr, bool source_ends = false) {
    LoopParts parts;
    parts.open_source = [this] { return std::make_unique<TestSource>(camera); };
    parts.source_ends = source_ends;
    const auto infer = [this](const ImageView& frame1, const ImageView&, FlowField& field, double time_s) {
      std::this_thread::sleep_for(std::chrono::milliseconds(infer_ms.load()));
      if (infer_fails) {
        throw_runtime("the network gave NaN");
      }
      if (infer_throws) {
        throw std::bad_alloc();
      }
      field.width = frame1.width;
      field.height = frame1.height;
      field.timestamp_s = time_s;
      const auto size = static_cast<std::size_t>(frame1.width) * static_cast<std::size_t>(frame1.height) * 2;
      field.flow.assign(size, 1.0F);
      field.uncertainty.assign(size, 0.1F);
      field.expected_error.assign(size, 0.1F);
    };
    parts.skill = skills::make_skill({}, skills::network_signal(infer, 1.2));
    parts.link =
        std::make_unique<Link>(std::make_unique<AutopilotTransport>(vehicle), LinkOptions{}, OutputKind::kRcOverride);
    parts.output = make_rc_output({});
    parts.log = log;
    parts.say = [](Level, const std::string&) {};
    loop = std::make_unique<FlightLoop>(loop_options(), std::move(parts));
    loop->start();
  }

  template <typename Condition>
  static bool wait_for(Condition condition, double seconds) {
    const double until_s = monotonic_s() + seconds;
    while (!condition() && monotonic_s() < until_s) {
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    return condition();
  }
  [[nodiscard]] bool overriding() const { return vehicle->overridden_us != 0; }

  void activate() {
    for (int attempt = 0; attempt < 5 && !overriding(); ++attempt) {  // a busy machine may be too slow for a moment
      vehicle->switch_us = 1000;
      std::this_thread::sleep_for(std::chrono::milliseconds(400));
      vehicle->switch_us = 2000;
      wait_for([this] { return overriding(); }, 1.0);
    }
    ASSERT_TRUE(overriding());
  }
  void expect_release() {
    const double began_s = monotonic_s();
    ASSERT_TRUE(wait_for([this] { return !overriding(); }, 2.0));
    EXPECT_LT(monotonic_s() - began_s, 0.25);
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
    EXPECT_FALSE(overriding());
  }
};

TEST_F(FlightLoopTest, FaultsOfCameraAndNetworkRelease) {
  start();
  const std::vector<std::pair<const char*, std::function<void(bool)>>> faults = {
      {"stall", [this](bool on) { camera->stalled = on; }},  {"damage", [this](bool on) { camera->damaged = on; }},
      {"end", [this](bool on) { camera->ended = on; }},      {"NaN", [this](bool on) { infer_fails = on; }},
      {"exception", [this](bool on) { infer_throws = on; }}, {"slow", [this](bool on) { infer_ms = on ? 400 : 1; }},
  };
  for (const auto& [name, fault] : faults) {
    SCOPED_TRACE(name);
    activate();
    fault(true);
    expect_release();
    fault(false);
    vehicle->switch_us = 1000;
    // A camera is opened again after a second.
    std::this_thread::sleep_for(std::chrono::milliseconds(name == std::string("end") ? 1300 : 600));
    EXPECT_FALSE(overriding());
  }
  EXPECT_GE(camera->opened.load(), 2);
  loop->request_stop();
  ASSERT_TRUE(loop->join(3.0));
  const auto statistics = loop->statistics();
  EXPECT_GE(statistics.activations, faults.size());
  EXPECT_GT(statistics.frames, 100U);
  EXPECT_GT(statistics.damaged, 2U);
  EXPECT_GT(statistics.network_failures, 2U);
  EXPECT_GT(statistics.dropped, 5U) << "while inference was slow, newer frames replaced older ones";
  EXPECT_GT(statistics.commands_sent, 10U);
  EXPECT_GT(statistics.releases_sent, 30U);
  EXPECT_GT(statistics.capture_to_command.count(), 100U);
}

TEST_F(FlightLoopTest, StopReleasesFirst) {
  start();
  activate();
  loop->request_stop();
  expect_release();
  EXPECT_TRUE(loop->join(2.0));
  EXPECT_TRUE(loop->finished());
}

TEST_F(FlightLoopTest, ARecordingEndsTheFlight) {
  start(nullptr, true);
  activate();
  camera->ended = true;
  ASSERT_TRUE(wait_for([this] { return loop->finished(); }, 3.0));
  EXPECT_FALSE(overriding());
  EXPECT_TRUE(loop->join(2.0));
}

TEST_F(FlightLoopTest, TheLogTellsWhatHappened) {
  const io::testing::TempFolder temp;
  const fs::path& folder = temp.path();
  LogOptions options;
  options.folder = folder.string();
  options.frame_every = 10;
  FlightLog log(options);
  start(&log);
  activate();
  vehicle->switch_us = 1000;
  expect_release();
  loop->request_stop();
  ASSERT_TRUE(loop->join(3.0));
  log.close();
  EXPECT_FALSE(log.failed());
  std::ifstream stream(log.path());
  std::string text((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  for (const char* part : {"\"type\": \"frame\"", "\"type\": \"state\"", "\"state\": \"active\"",
                           "released (switch_off)", "\"mean_uncertainty\": 0.14", "\"pulses_us\": [1500, "}) {
    EXPECT_NE(text.find(part), std::string::npos) << part;
  }
  EXPECT_TRUE(fs::exists(folder / "flight-0001" / "000010.jpg"));
}

TEST(FlightLoopOptions, ASwitchThatIsOverriddenIsRefused) {
  LoopOptions options = loop_options();
  options.switch_channel = 2;
  LoopParts parts;
  parts.output = make_rc_output({});
  EXPECT_THROW(FlightLoop(options, std::move(parts)), Error);
}

}  // namespace
}  // namespace ajna::flight
