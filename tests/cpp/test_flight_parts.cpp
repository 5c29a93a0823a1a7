// SPDX-License-Identifier: MIT
// Logs, histograms, sources, the model's self-test, the emergency release.
#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <cmath>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/flight/attitude_history.hpp"
#include "ajna/flight/emergency.hpp"
#include "ajna/flight/flight_log.hpp"
#include "ajna/flight/json_line.hpp"
#include "ajna/flight/latency.hpp"
#include "ajna/flight/latest.hpp"
#include "ajna/flight/self_test.hpp"
#include "ajna/flight/sender_clock.hpp"
#include "ajna/flight/source.hpp"
#include "ajna/io/image_io.hpp"
#include "io_files.hpp"

namespace ajna::flight {
namespace {

namespace fs = std::filesystem;

TEST(FlightLog, ADiskThatRefusesMoreIsCountedAndNothingElse) {
  const io::testing::TempFolder temp;
  LogOptions options;
  options.folder = temp.path().string();
  // The system refuses to let any file grow beyond this, as a full disk would.
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &before), 0);
  const rlimit small{1000, before.rlim_max};
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &small), 0);
  FlightLog log(options);
  for (int i = 0; i < 1000; ++i) {
    log.write(std::string(50, 'x'));
  }
  log.close();
  ::setrlimit(RLIMIT_FSIZE, &before);
  std::signal(SIGXFSZ, handler);
  EXPECT_TRUE(log.failed());
  EXPECT_GT(log.lost(), 900U);
  EXPECT_LE(fs::file_size(log.path()), 1000U);
}

TEST(FlightLog, ALimitEndsTheLogNotTheFlight) {
  LogOptions options;
  const io::testing::TempFolder temp;
  options.folder = temp.path().string();
  options.max_bytes = 1000;
  FlightLog log(options);
  for (int i = 0; i < 1000; ++i) {
    log.write(std::string(50, 'x'));
  }
  log.close();
  EXPECT_LE(fs::file_size(log.path()), 1100U);
  EXPECT_GT(log.lost(), 900U);
}

TEST(FlightLog, AFolderThatCannotBeMadeIsAnError) {
  LogOptions options;
  options.folder = "/proc/ajna";
  EXPECT_THROW(FlightLog{options}, Error);
}

TEST(JsonLine, EscapesAndHasNoNaN) {
  EXPECT_EQ(JsonLine().add("a", 1.5).add("b", "x\"\\\n\x80").add("c", std::nan("")).add("d", true).add("e", -3).str(),
            "{\"a\": 1.5, \"b\": \"x\\\"\\\\\\u000a\\u0080\", \"c\": null, \"d\": true, \"e\": -3}");
  EXPECT_EQ(JsonLine().add("v", std::vector<double>{1, 2.25}).add_null("n").str(), "{\"v\": [1, 2.25], \"n\": null}");
}

TEST(Latency, QuantilesAreUpperBinEdges) {
  LatencyHistogram histogram;
  EXPECT_EQ(histogram.quantile_ms(0.5), 0.0);
  for (int i = 0; i < 100; ++i) {
    histogram.add(1e-3 * i + 0.5e-3);
  }
  EXPECT_DOUBLE_EQ(histogram.quantile_ms(0.5), 50.0);
  EXPECT_DOUBLE_EQ(histogram.quantile_ms(0.99), 99.0);
  histogram.add(12.0);
  histogram.add(std::nan(""));
  EXPECT_EQ(histogram.count(), 101U);
  EXPECT_DOUBLE_EQ(histogram.quantile_ms(1.0), 12000.0);
}

TEST(Latest, KeepsTheOneBefore) {
  Latest<int> place;
  std::optional<int> before = 7;
  place.put(1);
  EXPECT_EQ(place.take(0.0, &before), 1);
  EXPECT_FALSE(before) << "nothing was overwritten";
  place.put(2);
  place.put(3);
  place.put(4);
  EXPECT_EQ(place.take(0.0, &before), 4);
  EXPECT_EQ(before, 3);
  EXPECT_EQ(place.dropped(), 2U);
  EXPECT_FALSE(place.take(0.0, &before));
  EXPECT_FALSE(before);
}

TEST(SenderClock, TakesTheDelaysOut) {
  SenderClock clock;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> delay_s(0.002, 0.02);
  double worst_s = 0.0;
  for (int i = 0; i < 3000; ++i) {  // a minute at 50 Hz; the sender's clock runs 50 ppm fast and began at 7.3 s of ours
    const double sent_s = 7.3 + 0.02 * i;
    const double arrival_s = sent_s + delay_s(random);
    const double found_s = clock.sent_s(static_cast<std::uint32_t>(1000.0 * 1.00005 * 0.02 * i + 1000.0), arrival_s);
    EXPECT_LE(found_s, arrival_s);
    if (i > 100) {
      worst_s = std::max(worst_s, std::abs(found_s - sent_s - 0.002));
    }
  }
  EXPECT_LT(worst_s, 0.003);  // stamps are whole milliseconds
}

TEST(SenderClock, GoesByTheArrivalWithoutAClock) {
  SenderClock clock;
  for (int i = 0; i < 10; ++i) {
    EXPECT_DOUBLE_EQ(clock.sent_s(0, 5.0 + i), 5.0 + i);
  }
}

TEST(SenderClock, FollowsAJump) {
  SenderClock clock;
  EXPECT_DOUBLE_EQ(clock.sent_s(1000, 5.0), 5.0);
  EXPECT_NEAR(clock.sent_s(1020, 5.03), 5.02, 1e-4);  // ten milliseconds late
  EXPECT_DOUBLE_EQ(clock.sent_s(30, 5.04), 5.04);     // the autopilot has begun anew
  EXPECT_DOUBLE_EQ(clock.sent_s(50, 5.06), 5.06);
  EXPECT_NEAR(clock.sent_s(70, 5.09), 5.08, 1e-4);
  EXPECT_DOUBLE_EQ(clock.sent_s(5000, 5.10), 5.10);  // its clock was set
  EXPECT_NEAR(clock.sent_s(5020, 5.15), 5.12, 1e-4);
  EXPECT_DOUBLE_EQ(clock.sent_s(5040, 9.0), 9.0);  // nothing for seconds: ours may have jumped
}

TEST(AttitudeHistory, BetweenSamplesAndALittleBeyond) {
  AttitudeHistory history;
  EXPECT_FALSE(history.at(0.0).has_value());
  const Eigen::Vector3d rates(0, 0, 2.0);
  history.add({{1.0, {0, 0, 3.1}, rates}, {1.1, {0, 0, 3.3}, rates}});  // through half a turn
  const auto yaw_at = [&](double time_s) { return history.at(time_s)->yaw_rad; };
  EXPECT_NEAR(yaw_at(1.0), 3.1, 1e-9);
  EXPECT_NEAR(std::remainder(yaw_at(1.05) - 3.2, 2 * M_PI), 0.0, 1e-9);
  EXPECT_NEAR(std::remainder(yaw_at(1.15) - 3.4, 2 * M_PI), 0.0, 1e-9) << "by its rates";
  EXPECT_FALSE(history.at(1.21).has_value());
  EXPECT_FALSE(history.at(0.99).has_value());
  history.add({{2.0, {0, 0, 0}, rates}});
  EXPECT_FALSE(history.at(1.5).has_value()) << "too far from both";
}

TEST(AttitudeHistory, AxesOfTheCamera) {
  AttitudeHistory history;
  // Nose up by 0.2, camera up by 0.1, heading east.
  history.add({{1.0, {0, 0.2, M_PI / 2}, {0, 0, 0}}});
  const auto attitude = history.at(1.0, 0.1);
  ASSERT_TRUE(attitude);
  EXPECT_NEAR(attitude->yaw_rad, M_PI / 2, 1e-12);
  const Eigen::Vector3d axis = attitude->heading_from_camera.col(2);  // optical axis: ahead and up by 0.3
  EXPECT_NEAR((axis - Eigen::Vector3d(std::cos(0.3), 0, -std::sin(0.3))).norm(), 0.0, 1e-12);
  const Eigen::Vector3d east = attitude->world_from_camera().col(2);
  EXPECT_NEAR((east - Eigen::Vector3d(0, std::cos(0.3), -std::sin(0.3))).norm(), 0.0, 1e-12);
  history.add({{1.1, {0.3, 0, 0}, {0, 0, 0}}});  // right side down: the camera's right axis points down
  EXPECT_NEAR(history.at(1.1)->heading_from_camera(2, 0), std::sin(0.3), 1e-12);
}

FlowField field_of(const ImageView& frame, float flow, float uncertainty) {
  FlowField field;
  field.width = frame.width;
  field.height = frame.height;
  const auto size = static_cast<std::size_t>(frame.width) * static_cast<std::size_t>(frame.height) * 2;
  field.flow.assign(size, flow);
  field.uncertainty.assign(size, uncertainty);
  field.expected_error.assign(size, 0.1F);
  return field;
}

TEST(SelfTest, RefusesWhatIsNoNetwork) {
  const auto varied = [](const ImageView& frame1, const ImageView& frame2) {
    FlowField field = field_of(frame1, 0.0F, 0.0F);
    for (std::size_t i = 0; i < field.flow.size(); ++i) {
      const auto difference = static_cast<float>(frame2.data[i]) - static_cast<float>(frame1.data[i]);
      field.flow[i] = 0.01F * difference;
      field.uncertainty[i] = 0.01F * std::abs(difference);
    }
    return field;
  };
  EXPECT_NO_THROW(test_model([&](auto& a, auto& b, FlowField& f, double) { f = varied(a, b); }, 64, 48));
  const auto refused = [](const skills::InferFunction& infer, const char* word) {
    try {
      test_model(infer, 64, 48);
      ADD_FAILURE() << "accepted: " << word;
    } catch (const Error& error) {
      EXPECT_NE(std::string(error.what()).find(word), std::string::npos) << error.what();
    }
  };
  refused([](auto& a, auto&, FlowField& f, double) { f = field_of(a, 1.0F, 0.5F); }, "same at every pixel");
  refused([&](auto& a, auto&, FlowField& f, double) { f = varied(a, test_frame(64, 48, 3, 0, 0).view()); },
          "does not depend");
  refused(
      [&](auto& a, auto& b, FlowField& f, double) {
        f = varied(a, b);
        f.flow[7] = std::numeric_limits<float>::quiet_NaN();
      },
      "not finite");
  refused(
      [&](auto& a, auto& b, FlowField& f, double) {
        f = varied(a, b);
        f.uncertainty[7] = -1.0F;
      },
      "negative");
  refused(
      [&](auto& a, auto&, FlowField& f, double) {
        f = field_of(ImageView{a.data, 32, 24, 3, 96}, 1, 1);
      },
      "another size");
}

TEST(SelfTest, KnowsHowLongAPairTakes) {
  int calls = 0;
  const double pair_s = inference_s(
      [&](auto& a, auto&, FlowField& f, double) {
        f = field_of(a, 1.0F, 0.5F);
        std::this_thread::sleep_for(std::chrono::milliseconds(calls++ == 0 ? 200 : 10));  // the slowest does not count
      },
      64, 48);
  EXPECT_EQ(calls, 5);
  EXPECT_GE(pair_s, 0.01);
  EXPECT_LT(pair_s, 0.2);
}

TEST(SelfTest, KnowsHowOldCommandsGet) {
  EXPECT_DOUBLE_EQ(oldest_command_s(0.02, 0.03), 0.05);  // taken at once, replaced after the next frame
  EXPECT_DOUBLE_EQ(oldest_command_s(0.05, 0.03), 0.13);  // waits for the network, which then has the next one to do
}

TEST(SelfTest, KnowsHowLateTheComputerPlans) {
  const Pace quick = pace(0.02, 0.04, 0.01);
  EXPECT_DOUBLE_EQ(quick.planning_rate_hz, 25.0);  // every frame, at once
  EXPECT_DOUBLE_EQ(quick.latency_s, 0.03);
  const Pace slow = pace(0.1, 0.04, 0.01);
  EXPECT_DOUBLE_EQ(slow.planning_rate_hz, 10.0);  // the newest frame, which has waited for 0 to 0.04 s
  EXPECT_DOUBLE_EQ(slow.latency_s, 0.13);
}

TEST(Source, FolderWithTimeStampsIsPlayedAtThem) {
  const io::testing::TempFolder temp;
  const fs::path& folder = temp.path();
  for (int i = 0; i < 3; ++i) {
    io::write_image(folder / ("f" + std::to_string(i) + ".png"), test_frame(16, 16, 1, i, 0).view());
  }
  std::ofstream(folder / "timestamps.txt") << "10.0\n10.05\n10.2\n";
  SourceOptions options;
  options.kind = SourceKind::kFolder;
  options.path = folder.string();
  const auto source = open_source(options);
  std::vector<double> times_s;
  for (SourceResult result; (result = source->next()).kind != SourceResult::Kind::kEnd;) {
    if (result.kind == SourceResult::Kind::kFrame) {
      EXPECT_LE(result.frame.captured_s, monotonic_s());
      EXPECT_GT(result.frame.captured_s, monotonic_s() - 0.05);
      times_s.push_back(result.frame.captured_s);
    }
  }
  ASSERT_EQ(times_s.size(), 3U);
  EXPECT_NEAR(times_s[1] - times_s[0], 0.05, 1e-6);
  EXPECT_NEAR(times_s[2] - times_s[0], 0.2, 1e-6);
  std::ofstream(folder / "timestamps.txt") << "10.0\n9.0\n10.2\n";
  EXPECT_THROW(open_source(options), Error);
  std::ofstream(folder / "timestamps.txt") << "10.0\n11.0\n";
  EXPECT_THROW(open_source(options), Error);
}

TEST(Source, SpoolTakesTheNewestAndNamesTheDamaged) {
  const io::testing::TempFolder temp;
  const fs::path& folder = temp.path();
  SourceOptions options;
  options.kind = SourceKind::kSpool;
  options.path = folder.string();
  const auto source = open_source(options);
  EXPECT_EQ(source->next().kind, SourceResult::Kind::kNothing);
  for (int i = 0; i < 3; ++i) {
    io::write_image(folder / ("f" + std::to_string(i) + ".png"), test_frame(16, 16, 1, i, 0).view());
  }
  const auto result = source->next();
  ASSERT_EQ(result.kind, SourceResult::Kind::kFrame);
  EXPECT_EQ(result.frame.name, "f2.png");
  std::ofstream(folder / "bad.png") << "no image";
  EXPECT_EQ(source->next().kind, SourceResult::Kind::kDamaged);
  EXPECT_EQ(source->next().kind, SourceResult::Kind::kNothing);
  options.path = "/nonexistent";
  EXPECT_THROW(open_source(options), Error);
}

TEST(Emergency, WritesTheReleaseOnlyWhileArmed) {
  std::array<int, 2> ends{};
  ASSERT_EQ(::pipe(ends.data()), 0);
  const std::array<std::uint8_t, 4> bytes = {1, 2, 3, 4};
  EmergencyRelease::disarm();
  EmergencyRelease::fire();
  EmergencyRelease::arm(ends[1], bytes.data(), bytes.size());
  EmergencyRelease::fire();
  EmergencyRelease::disarm();
  EmergencyRelease::fire();
  ::close(ends[1]);
  std::array<std::uint8_t, 64> read{};
  EXPECT_EQ(::read(ends[0], read.data(), read.size()), 12);
  EXPECT_EQ(read[0], 1);
  EXPECT_EQ(read[11], 4);
  ::close(ends[0]);
}

}  // namespace
}  // namespace ajna::flight
