// SPDX-License-Identifier: MIT
// Whole skills on 320x240 frames, as they fly, but for the network: its answer is there at once. Turning or the plane's
// motion is taken out of every pair, so the pictures are warped, too. The aim is 2 ms a frame on one core.
#include <benchmark/benchmark.h>

#include <Eigen/Geometry>
#include <cmath>
#include <memory>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "ajna/base/memory.hpp"
#include "ajna/skills/skill.hpp"
#include "ajna/tasks/segment.hpp"
#include "frames.hpp"

namespace {

using namespace ajna::bench;
using namespace ajna::skills;

constexpr double kFov_rad = 1.2;
constexpr double kFrame_s = 1.0 / 30.0;

/// The wall, seen from a little aside.
cv::Mat wall(double shift_px) { return moved(textured(1), shift_px, -0.5 * shift_px); }

/// A network's answer: noise, an upright rim, and something of `radius` at `x`.
ajna::FlowField answer(double x, int radius) {
  const cv::Mat map = map_with({cvRound(x), 120}, radius);
  ajna::FlowField field;
  field.width = kWidth;
  field.height = kHeight;
  field.flow.assign(std::size_t{2} * kWidth * kHeight, 1.5F);
  field.uncertainty.resize(field.flow.size());
  for (std::size_t i = 0; i < field.uncertainty.size(); ++i) {
    field.uncertainty[i] = map.at<float>(static_cast<int>(i / 2)) * 0.7F;
  }
  field.expected_error = field.uncertainty;
  return field;
}

/// What a network writes is its own cost, but for the plane that changes.
void give(const ajna::FlowField& from, ajna::FlowField& field) {
  if (field.width == 0) {
    field = from;
  }
  field.uncertainty = from.uncertainty;
}

/// Frames that come one after another, and the network's answers to them, over and over.
struct Flight {
  std::vector<cv::Mat> frames;
  std::vector<ajna::FlowField> answers;
  std::size_t count = 0;

  std::unique_ptr<Skill> skill(Task task) {
    cv::setNumThreads(1);
    SkillOptions options;
    options.task = task;
    options.horizontal_fov_rad = kFov_rad;
    options.settle_s = 0.0;
    return make_skill(options,
                      network_signal([this](const ajna::ImageView&, const ajna::ImageView&, ajna::FlowField& field,
                                            double) { give(answers[count % answers.size()], field); },
                                     kFov_rad));
  }

  /// The next frame, of a vehicle that flies ahead and turns a little.
  SkillInput next(double speed_m_s) {
    ++count;
    SkillInput input;
    input.frame = view_of(frames[count % frames.size()]);
    input.captured_s = static_cast<double>(count) * kFrame_s;
    const double yaw_rad = 0.02 * std::sin(0.3 * static_cast<double>(count));
    input.attitude = Attitude{Attitude::level(), yaw_rad};
    input.velocity_m_s = Eigen::Vector3d(speed_m_s, 0.0, 0.0);
    return input;
  }
};

/// Something comes nearer, again and again: background, track and direction.
void dodge(benchmark::State& state) {
  Flight flight{{wall(0), wall(1)}, {}};
  for (int i = 0; i < 40; ++i) {
    flight.answers.push_back(answer(120 + 3 * i, i < 25 ? 0 : i - 20));
  }
  const auto skill = flight.skill(Task::kDodge);
  for (auto _ : state) {
    benchmark::DoNotOptimize(skill->plan(flight.next(0.0)));
  }
}

/// At 4 m/s past upright things: horizon, memory and corridor.
void navigate(benchmark::State& state) {
  Flight flight{{wall(0), wall(3)}, {}};
  for (int i = 0; i < 40; ++i) {
    flight.answers.push_back(answer(60 + 5 * i, 20));
  }
  const auto skill = flight.skill(Task::kNavigate);
  for (auto _ : state) {
    benchmark::DoNotOptimize(skill->plan(flight.next(4.0)));
  }
}

/// Before a wall without a gap: alignment, stacking, looking.
void gap_explore(benchmark::State& state) {
  Flight flight{{wall(0), wall(2), wall(4)}, {answer(180, 2)}};
  const auto skill = flight.skill(Task::kGap);
  for (auto _ : state) {
    benchmark::DoNotOptimize(skill->plan(flight.next(0.0)));
  }
}

/// A gap was found: levelling and tracking.
void gap_track(benchmark::State& state) {
  Flight flight{{wall(0), wall(2)}, {answer(180, 45)}};
  const auto skill = flight.skill(Task::kGap);
  SkillOutput output;
  for (int i = 0; i < 100 && output.status != "tracking"; ++i) {
    output = skill->plan(flight.next(0.0));
  }
  for (auto _ : state) {
    output = skill->plan(flight.next(0.0));
    if (output.status != "tracking") {
      state.SkipWithError("the gap is not tracked");
      break;
    }
  }
}

/// Two views of a table: alignment, attention, segmentation.
void pile(benchmark::State& state) {
  Flight flight{{wall(0), wall(4)}, {answer(180, 45)}};
  const Signal signal = network_signal([&](const ajna::ImageView&, const ajna::ImageView&, ajna::FlowField& field,
                                           double) { give(flight.answers[0], field); },
                                       kFov_rad);
  Snapshot first;
  Snapshot second;
  for (auto [snapshot, frame] : {std::pair{&first, &flight.frames[0]}, std::pair{&second, &flight.frames[1]}}) {
    snapshot->image = ajna::Image(kWidth, kHeight);
    std::copy(frame->data, frame->data + snapshot->image.size_bytes(), snapshot->image.data());
  }
  for (auto _ : state) {
    const SignalMap seen = signal(first, second, CommonMotion::kPlane);
    benchmark::DoNotOptimize(ajna::tasks::segment_pile(first.image.view(), seen.map));
  }
}

BENCHMARK(reference_blur_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(dodge)->Unit(benchmark::kMillisecond);
BENCHMARK(navigate)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_explore)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_track)->Unit(benchmark::kMillisecond);
BENCHMARK(pile)->Unit(benchmark::kMillisecond);

const bool kMemoryKept = ajna::keep_freed_memory();  // as the flight program does

}  // namespace
