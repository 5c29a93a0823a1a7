// SPDX-License-Identifier: MIT
// The pipelines on 320x240 maps, without the network: under 2 ms a frame on one core is the aim.
#include <benchmark/benchmark.h>

#include <opencv2/core.hpp>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgproc.hpp>

#include "ajna/base/memory.hpp"
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/gap.hpp"
#include "ajna/tasks/navigate.hpp"
#include "ajna/tasks/segment.hpp"

namespace {

using namespace ajna::tasks;

constexpr int kWidth = 320;
constexpr int kHeight = 240;

/// Noise about 0.3 with rims of things in it, as smooth as a network's output.
cv::Mat map_with(cv::Point center, int radius) {
  cv::setNumThreads(1);
  cv::Mat map(kHeight, kWidth, CV_32F);
  cv::RNG random(7);
  random.fill(map, cv::RNG::UNIFORM, 0.25, 0.35);
  cv::circle(map, center, radius, 1.4, cv::FILLED);
  cv::rectangle(map, {30, 20}, {60, 239}, 0.8, 6);
  cv::GaussianBlur(map, map, {0, 0}, 2.0);
  return map;
}

cv::Mat texture() {
  cv::Mat image(kHeight, kWidth, CV_8UC3);
  cv::RNG random(1);
  random.fill(image, cv::RNG::UNIFORM, 0, 256);
  cv::GaussianBlur(image, image, {0, 0}, 2.0);
  cv::normalize(image, image, 0, 255, cv::NORM_MINMAX);
  return image;
}

ajna::ImageView view_of(const cv::Mat& image) {
  return {image.data, image.cols, image.rows, 3, static_cast<std::ptrdiff_t>(image.step[0])};
}

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
  const cv::Mat frame = texture();
  GapPipeline pipeline;
  double t = 0.0;
  pipeline.step(view_of(frame), {}, t);
  for (auto _ : state) {
    benchmark::DoNotOptimize(pipeline.step(view_of(frame), map, t += 0.033));
  }
}

void gap_track_320x240(benchmark::State& state) {
  const cv::Mat map = map_with({180, 120}, 45);
  const cv::Mat frame = texture();
  const cv::Mat other = [&] {
    cv::Mat moved;
    const cv::Mat warp = (cv::Mat_<double>(2, 3) << 1, 0, 2, 0, 1, -1);
    cv::warpAffine(frame, moved, warp, frame.size(), cv::INTER_LINEAR, cv::BORDER_REFLECT);
    return moved;
  }();
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
  cv::Mat frame = texture();
  cv::circle(frame, {180, 120}, 45, {200, 60, 40}, cv::FILLED);
  SegmentOptions options;
  options.method = method;
  for (auto _ : state) {
    benchmark::DoNotOptimize(segment_pile(view_of(frame), map, options));
  }
}

/// What other figures can be compared with on another machine: one pass over a map.
void reference_blur_320x240(benchmark::State& state) {
  cv::setNumThreads(1);
  const cv::Mat map(kHeight, kWidth, CV_32F, cv::Scalar(0.3F));
  cv::Mat smooth;
  for (auto _ : state) {
    cv::GaussianBlur(map, smooth, {}, 1.5, 1.5, cv::BORDER_REPLICATE);
    benchmark::DoNotOptimize(smooth.data);
  }
}

BENCHMARK(reference_blur_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(find_regions_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(dodge_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(navigate_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_stack_and_detect_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK(gap_track_320x240)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(segment_320x240, watershed, SegmentMethod::kWatershed)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(segment_320x240, grabcut, SegmentMethod::kGrabCut)->Unit(benchmark::kMillisecond);

const bool kMemoryKept = ajna::keep_freed_memory();  // as the flight program does

}  // namespace
