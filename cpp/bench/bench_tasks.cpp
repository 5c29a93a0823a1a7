// SPDX-License-Identifier: MIT
// The pipelines on 320x240 maps, without the network: under 2 ms a frame on one core is the aim.
#include <benchmark/benchmark.h>

#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "ajna/base/memory.hpp"
#include "ajna/tasks/closer_look.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/gap.hpp"
#include "ajna/tasks/navigate.hpp"
#include "ajna/tasks/segment.hpp"
#include "frames.hpp"

namespace {

using namespace ajna::bench;
using namespace ajna::tasks;

void find_regions_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 20);
  for (auto _ : state) {
    benchmark::DoNotOptimize(find_regions(map));
  }
}

void dodge_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 20);
  DodgePipeline pipeline;
  double t = 0.0;
  for (auto _ : state) {
    benchmark::DoNotOptimize(pipeline.step(map, t += 0.033));
  }
}

void closer_look_320x240(benchmark::State& state) {
  cv::Mat mask(240, 320, CV_8U, cv::Scalar(0));
  cv::circle(mask, {180, 120}, 8, 255, cv::FILLED);
  const cv::Mat frame = textured(1);
  const cv::Mat other = moved(frame, 2, -1);
  cv::Mat map;
  for (auto _ : state) {
    const CloserLook look = closer_look_at(mask);
    benchmark::DoNotOptimize(enlarge(view_of(frame), look));
    benchmark::DoNotOptimize(enlarge(view_of(other), look));
    if (map.empty()) {
      cv::resize(map_with({180, 120}, 20), map, look.size);
    }
    benchmark::DoNotOptimize(outline(map, mask, look));
  }
}

void navigate_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 20);
  NavigatePipeline pipeline;
  double t = 0.0;
  for (auto _ : state) {
    benchmark::DoNotOptimize(pipeline.step(map, t += 0.033));
  }
}

void gap_stack_and_detect_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 4);  // no gap in it: every step stacks and looks
  const cv::Mat frame = textured(1);
  GapPipeline pipeline;
  double t = 0.0;
  pipeline.step(view_of(frame), {}, t);
  for (auto _ : state) {
    benchmark::DoNotOptimize(pipeline.step(view_of(frame), map, t += 0.033));
  }
}

void gap_track_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 45);
  const cv::Mat frame = textured(1);
  const cv::Mat other = moved(frame, 2, -1);
  GapPipeline pipeline;
  double t = 0.0;
  pipeline.step(view_of(frame), {}, t);
  GapStatus status = GapStatus::kExploring;
  while (status == GapStatus::kExploring) {
    status = pipeline.step(view_of(frame), map, t += 0.033).status;
  }
  bool odd = false;
  for (auto _ : state) {
    odd = !odd;  // there and back, so that the contour stays
    const GapResult result = pipeline.step(view_of(odd ? other : frame), {}, t += 0.033);
    if (result.status != GapStatus::kTracking) {
      state.SkipWithError("the gap is not tracked");
      break;
    }
  }
}

void segment_320x240(benchmark::State& state, SegmentMethod method) {
  const cv::Mat map = map_with({180, 120}, 45);
  cv::Mat frame = textured(1);
  cv::circle(frame, {180, 120}, 45, {200, 60, 40}, cv::FILLED);
  SegmentOptions options;
  options.method = method;
  for (auto _ : state) {
    benchmark::DoNotOptimize(segment_pile(view_of(frame), map, options));
  }
}

BENCHMARK(reference_blur_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(find_regions_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(dodge_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(closer_look_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(navigate_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_stack_and_detect_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_track_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(segment_320x240, watershed, SegmentMethod::kWatershed)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(segment_320x240, grabcut, SegmentMethod::kGrabCut)->Unit(benchmark::kMillisecond);

const bool kMemoryKept = ajna::keep_freed_memory();  // as the flight program does

}  // namespace
