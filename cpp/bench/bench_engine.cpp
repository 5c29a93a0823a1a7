// SPDX-License-Identifier: MIT
//
// Latency of a frame pair at 320x240 beside the rate of a matrix product in the same run. The network's share of that
// rate (counter "of_gemm") is comparable between machines, milliseconds are not; rates count the processor time of all
// threads, so that other programs on the machine hardly change them.
#include <ATen/Parallel.h>
#include <benchmark/benchmark.h>
#include <torch/torch.h>
#include <unistd.h>

#include <algorithm>
#include <ctime>
#include <filesystem>
#include <random>
#include <string>
#include <vector>

#include "ajna/engine/flow_engine.hpp"
#include "ajna/nn/checkpoint.hpp"

namespace {

constexpr int kWidth = 320, kHeight = 240;

/// The paper's network with initial weights: the time does not depend on their values.
class Model {
 public:
  Model()
      : path_(std::filesystem::temp_directory_path() / ("ajna-bench-" + std::to_string(::getpid()) + ".safetensors")) {
    torch::manual_seed(1);
    ajna::nn::FlowNet net;
    ajna::nn::Metadata metadata;
    metadata.name = "bench";
    metadata.net = net->config();
    metadata.loss = "none";
    const auto raw = torch::arange(0, 5121, torch::kFloat32) / 64 - 16;
    metadata.table = {-16.0, 1.0 / 64.0, torch::softplus(raw), torch::softplus(raw).square()};
    ajna::nn::save_checkpoint(path_.string(), *net, metadata);
  }
  ~Model() { std::filesystem::remove(path_); }
  Model(const Model&) = delete;
  Model& operator=(const Model&) = delete;
  [[nodiscard]] std::string path() const { return path_.string(); }

 private:
  std::filesystem::path path_;
};

const Model& model() {
  static const Model instance;
  return instance;
}

ajna::Image noise(unsigned seed) {
  ajna::Image image(kWidth, kHeight);
  std::mt19937 random(seed);
  for (std::size_t i = 0; i < image.size_bytes(); ++i) {
    image.data()[i] = static_cast<std::uint8_t>(random() & 0xFF);
  }
  return image;
}

/// Seconds of processor time that the whole process has used.
double cpu_seconds() {
  timespec now{};
  ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

/// FLOP per second of a 1024^3 product, the median of a few runs right now.
double gemm_rate(torch::ScalarType type) {
  constexpr std::int64_t kSide = 1024;
  constexpr int kRuns = 9;
  const c10::InferenceMode inference;
  const auto a = torch::rand({kSide, kSide}).to(type), b = torch::rand({kSide, kSide}).to(type);
  torch::mm(a, b);
  std::vector<double> seconds;
  for (int i = 0; i < kRuns; ++i) {
    const double start = cpu_seconds();
    benchmark::DoNotOptimize(torch::mm(a, b).const_data_ptr());
    seconds.push_back(cpu_seconds() - start);
  }
  std::nth_element(seconds.begin(), seconds.begin() + kRuns / 2, seconds.end());
  return 2.0 * kSide * kSide * kSide / seconds[kRuns / 2];
}

void engine_latency(benchmark::State& state, bool bfloat16) {
  ajna::engine::EngineOptions options;
  options.bfloat16 = bfloat16;
  options.threads = static_cast<int>(state.range(0));
  const auto engine = ajna::engine::FlowEngine::load(model().path(), options);
  const ajna::Image frame1 = noise(1), frame2 = noise(2);
  ajna::FlowField field;
  engine.warm_up(kWidth, kHeight);
  const auto type = bfloat16 ? torch::kBFloat16 : torch::kFloat32;
  double reference = gemm_rate(type);
  const double start = cpu_seconds();
  for (auto _ : state) {
    engine.infer_into(frame1.view(), frame2.view(), field);
    benchmark::DoNotOptimize(field.flow.data());
  }
  const double seconds = cpu_seconds() - start;
  reference = 0.5 * (reference + gemm_rate(type));  // before and after, as other programs come and go
  const double flop = 2.0 * static_cast<double>(ajna::nn::count_macs({}, kHeight, kWidth));
  const double rate = flop * static_cast<double>(state.iterations()) / seconds;
  state.counters["GFLOP/s"] = rate / 1e9;
  state.counters["gemm_GFLOP/s"] = reference / 1e9;
  state.counters["of_gemm"] = rate / reference;
}

void engine_float32(benchmark::State& state) { engine_latency(state, false); }
void engine_bfloat16(benchmark::State& state) { engine_latency(state, true); }

void thread_counts(benchmark::internal::Benchmark* bench) {
  bench->ArgName("threads")->Arg(1)->Unit(benchmark::kMillisecond)->UseRealTime();
  if (at::get_num_threads() > 1) {
    bench->Arg(at::get_num_threads());
  }
}

BENCHMARK(engine_float32)->Apply(thread_counts);
BENCHMARK(engine_bfloat16)->Apply(thread_counts);

}  // namespace
