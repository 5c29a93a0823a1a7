// SPDX-License-Identifier: MIT
// The network as training runs it (forward; forward, loss and backward), at the paper's 320x240.
#include <benchmark/benchmark.h>
#include <torch/torch.h>

#include "ajna/loss/uncertainty_loss.hpp"
#include "ajna/nn/flow_net.hpp"

namespace {

constexpr std::int64_t kHeight = 240, kWidth = 320;

void report_flops(benchmark::State& state, std::int64_t batch, double passes) {
  const double flop = 2.0 * static_cast<double>(ajna::nn::count_macs(ajna::nn::NetConfig{}, kHeight, kWidth));
  state.counters["GFLOP/s"] = benchmark::Counter(flop * static_cast<double>(batch) * passes * 1e-9,
                                                 benchmark::Counter::kIsIterationInvariantRate);
}

void forward(benchmark::State& state) {
  const torch::NoGradGuard no_grad;
  const std::int64_t batch = state.range(0);
  ajna::nn::FlowNet net{ajna::nn::NetConfig{}};
  net->eval();
  const auto frames = torch::rand({batch, 6, kHeight, kWidth}) * 2 - 1;
  for (int i = 0; i < 2; ++i) {  // the first runs choose algorithms
    net->forward(frames);
  }
  for (auto _ : state) {
    benchmark::DoNotOptimize(net->forward(frames));
  }
  report_flops(state, batch, 1);
}
BENCHMARK(forward)->Arg(1)->Arg(8)->Unit(benchmark::kMillisecond)->UseRealTime();

void training_step(benchmark::State& state) {
  const std::int64_t batch = state.range(0);
  ajna::nn::FlowNet net{ajna::nn::NetConfig{}};
  net->train();
  const ajna::loss::UncertaintyLoss loss{ajna::loss::LossConfig{}};
  const auto frames = torch::rand({batch, 6, kHeight, kWidth}) * 2 - 1;
  const auto target = torch::randn({batch, 2, kHeight, kWidth});
  for (auto _ : state) {
    const auto out = net->forward(frames);
    loss(out.narrow(1, 0, 2), out.narrow(1, 2, 2), target).backward();
    net->zero_grad();
  }
  report_flops(state, batch, 3);
}
BENCHMARK(training_step)->Arg(4)->Unit(benchmark::kMillisecond)->UseRealTime();

}  // namespace
