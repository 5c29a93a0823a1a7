// SPDX-License-Identifier: MIT
#pragma once

#include <torch/torch.h>

#include <mutex>

namespace ajna::nn {

/// Puts the global CPU generator back at the end of a scope: building a network draws initial weights, and where these
/// are overwritten at once (loading, copying) the caller's random sequence must not notice.
class RandomStateGuard {
 public:
  RandomStateGuard() : generator_(at::detail::getDefaultCPUGenerator()) {
    const std::lock_guard<std::mutex> lock(generator_.mutex());
    state_ = generator_.get_state();
  }
  ~RandomStateGuard() {
    const std::lock_guard<std::mutex> lock(generator_.mutex());
    generator_.set_state(state_);
  }
  RandomStateGuard(const RandomStateGuard&) = delete;
  RandomStateGuard& operator=(const RandomStateGuard&) = delete;

 private:
  at::Generator generator_;
  torch::Tensor state_;
};

}  // namespace ajna::nn
