// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <cmath>
#include <cstdint>

namespace ajna::synth {

inline constexpr double kPi = 3.14159265358979323846;

/// Seeded draws on the CPU, so that equal seeds give equal scenes on every device.
class Random {
 public:
  explicit Random(std::uint64_t seed) : generator_(at::make_generator<at::CPUGeneratorImpl>(seed)) {}

  /// Uniform in [low, high), float32.
  [[nodiscard]] torch::Tensor uniform(torch::IntArrayRef shape, double low = 0.0, double high = 1.0) {
    return torch::rand(shape, generator_) * (high - low) + low;
  }
  /// exp(uniform) in [low, high), both > 0.
  [[nodiscard]] torch::Tensor log_uniform(torch::IntArrayRef shape, double low, double high) {
    return uniform(shape, std::log(low), std::log(high)).exp();
  }
  [[nodiscard]] torch::Tensor normal(torch::IntArrayRef shape, double stddev = 1.0) {
    return torch::randn(shape, generator_) * stddev;
  }
  /// True with the given probability.
  [[nodiscard]] torch::Tensor chance(torch::IntArrayRef shape, double probability) {
    return torch::rand(shape, generator_) < probability;
  }
  /// Uniform integers in [0, high), int64.
  [[nodiscard]] torch::Tensor integers(torch::IntArrayRef shape, std::int64_t high) {
    return torch::randint(high, shape, generator_, torch::TensorOptions().dtype(torch::kInt64));
  }
  [[nodiscard]] double number(double low = 0.0, double high = 1.0) { return uniform({1}, low, high).item<double>(); }
  [[nodiscard]] std::int64_t integer(std::int64_t high) { return integers({1}, high).item<std::int64_t>(); }

 private:
  at::Generator generator_;
};

/// Normal deviates made on `device` from a generator of their own.
inline torch::Tensor device_normal(torch::IntArrayRef shape, std::uint64_t seed, const torch::Device& device) {
  auto generator = at::globalContext().defaultGenerator(device).clone();
  generator.set_current_seed(seed);
  return torch::randn(shape, generator, torch::TensorOptions().device(device));
}

}  // namespace ajna::synth
