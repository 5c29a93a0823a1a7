// SPDX-License-Identifier: MIT
#include "ajna/nn/preprocess.hpp"

#include <string>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

void check_frame(const torch::Tensor& frame, const char* name) {
  if (!frame.defined() || frame.dim() != 4 || frame.size(1) != 3) {
    throw_invalid(std::string(name) + " of shape " + (frame.defined() ? c10::str(frame.sizes()) : "(none)") +
                  ": give RGB frames as [N, 3, H, W]");
  }
  if (frame.scalar_type() != torch::kUInt8 && !frame.is_floating_point()) {
    throw_invalid(std::string(name) + " of dtype " + std::string(c10::toString(frame.scalar_type())) +
                  ": give uint8, or floating point with values 0 to 255");
  }
}

}  // namespace

torch::Tensor network_input(const torch::Tensor& frame1, const torch::Tensor& frame2) {
  check_frame(frame1, "frame 1");
  check_frame(frame2, "frame 2");
  if (frame1.sizes() != frame2.sizes()) {
    throw_invalid("frame 1 " + c10::str(frame1.sizes()) + " and frame 2 " + c10::str(frame2.sizes()) +
                  " differ in shape: give two frames of equal size");
  }
  if (frame1.device() != frame2.device()) {
    throw_invalid("frame 1 is on " + frame1.device().str() + " and frame 2 on " + frame2.device().str() +
                  ": move both to one device");
  }
  return torch::cat({frame1, frame2}, 1).to(torch::kFloat32).div(127.5).sub(1.0);
}

}  // namespace ajna::nn
