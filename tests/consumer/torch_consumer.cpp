// SPDX-License-Identifier: MIT
// nn and loss through the installed headers, with tensors of LibTorch.
#include <cstdio>

#include "ajna/loss/uncertainty_loss.hpp"
#include "ajna/nn/flow_net.hpp"

int main() {
  ajna::nn::FlowNet net{ajna::nn::NetConfig{}};
  std::int64_t parameters = 0;
  for (const auto& parameter : net->parameters()) {
    parameters += parameter.numel();
  }
  const ajna::loss::UncertaintyLoss loss{ajna::loss::LossConfig{}};
  const auto expected = loss.expected_error(torch::zeros({1}));
  std::printf("%lld parameters, expected error at raw 0: %g\n", static_cast<long long>(parameters),
              expected.item<double>());
  return parameters == 2724980 ? 0 : 1;
}
