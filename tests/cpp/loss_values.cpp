// SPDX-License-Identifier: MIT
// Losses and gradients of choices read from standard input, as hexadecimal numbers on standard output: what
// tests/python/test_loss_parity.py holds against Python and YAML. A choice is a block of lines
//   f NAME-OR-EXPRESSION | h ... | g ... | parametrization ...
//   f.PARAMETER VALUE | ...
//   lam VALUE
//   preset NAME
//   end
// whose order does not matter except that `preset` comes first; what is not given keeps its default.
#include <cstdio>
#include <exception>
#include <iostream>
#include <map>
#include <string>

#include "ajna/loss/presets.hpp"
#include "ajna/loss/uncertainty_loss.hpp"

namespace {

using ajna::loss::LossConfig;
using ajna::loss::TermSpec;
using torch::Tensor;

/// The maps of test_loss_parity.py: exact in binary; [2, channels, 2, 3].
Tensor numbers(std::int64_t channels, std::int64_t factor, double offset) {
  const std::int64_t count = 2 * channels * 2 * 3;
  auto values = torch::arange(count, torch::TensorOptions().dtype(torch::kInt64));
  values = (values * factor + 11).remainder(193);
  return values.to(torch::kFloat64).div(64.0).add(offset).view({2, channels, 2, 3});
}

void print_hex(const Tensor& values) {
  const auto flat = values.detach().contiguous().view({-1});
  for (std::int64_t i = 0; i < flat.numel(); ++i) {
    std::printf(" %a", flat[i].item<double>());
  }
}

void evaluate(const LossConfig& config) {
  const ajna::loss::UncertaintyLoss loss(config);
  const auto target = numbers(3, 29, -1.5);
  const auto prediction = numbers(3, 71, -1.25).requires_grad_(true);
  // One raw per pixel, for every kind of f; none is 0, where kappa of a printed form has its pole.
  const auto raw = numbers(1, 47, -0.7421875).requires_grad_(true);
  const auto value = loss(prediction, raw, target);
  value.backward();
  print_hex(value.view({1}));
  print_hex(prediction.grad());
  print_hex(raw.grad());
  print_hex(loss.expected_error(raw));
  std::printf("\n");
}

int run() {
  LossConfig config;
  std::string line;
  while (std::getline(std::cin, line)) {
    const auto space = line.find(' ');
    const auto key = line.substr(0, space), value = space == std::string::npos ? "" : line.substr(space + 1);
    std::map<std::string, TermSpec*> terms = {
        {"f", &config.f}, {"h", &config.h}, {"g", &config.g}, {"parametrization", &config.parametrization}};
    const auto dot = key.find('.');
    if (key == "end") {
      evaluate(config);
      config = LossConfig{};
    } else if (key == "preset") {
      config = ajna::loss::preset(value).config;
    } else if (key == "lam") {
      config.lam = std::stod(value);
    } else if (dot != std::string::npos) {
      terms.at(key.substr(0, dot))->params[key.substr(dot + 1)] = std::stod(value);
    } else {
      *terms.at(key) = TermSpec{value};
    }
  }
  return 0;
}

}  // namespace

int main() {
  try {
    return run();
  } catch (const std::exception& error) {
    std::cerr << error.what() << '\n';
    return 1;
  }
}
