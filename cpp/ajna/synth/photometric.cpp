// SPDX-License-Identifier: MIT
#include "ajna/synth/photometric.hpp"

#include <algorithm>

namespace ajna::synth {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

constexpr std::int64_t kLights = 3;

}  // namespace

CameraEffects CameraEffects::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  const auto part = [&](const Tensor& x) { return x.slice(0, begin, end).to(device); };
  return {part(shutter), part(defocus_px), part(noise), part(gain1), part(gain2), part(gamma1), part(gamma2)};
}

CameraEffects draw_camera_effects(const SceneConfig& c, std::int64_t batch, Random& random, Random* extra) {
  const auto some = [&](double probability) { return random.chance({batch}, probability).to(torch::kFloat32); };
  CameraEffects effects;
  effects.shutter = some(c.blur_probability) * random.uniform({batch}, 0, c.shutter);
  effects.defocus_px = some(c.defocus_probability) * random.uniform({batch}, 0, c.defocus_max_px);
  effects.noise = random.uniform({batch}, 0, c.noise_max) / 255.0;
  effects.gain1 = random.uniform({batch, 1}, 0.75, 1.15) * torch::ones({1, 3});
  effects.gain2 = effects.gain1 * (1 + random.uniform({batch, 1}, -c.brightness_change, c.brightness_change)) *
                  (1 + random.uniform({batch, 3}, -c.color_change, c.color_change));
  effects.gamma1 = random.uniform({batch}, 0.8, 1.25);
  effects.gamma2 = effects.gamma1 * (1 + random.uniform({batch}, -c.gamma_change, c.gamma_change));
  if (c.jump_probability > 0) {
    Random& more = extra != nullptr ? *extra : random;
    const auto jumps = more.chance({batch, 1}, c.jump_probability).to(torch::kFloat32);
    effects.gain2 = effects.gain2 * (jumps * more.uniform({batch, 1}, -c.jump_stops, c.jump_stops)).exp2();
  }
  return effects;
}

Lights Lights::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  if (!x.defined()) {
    return {};
  }
  const auto part = [&](const Tensor& t) { return t.slice(0, begin, end).to(device); };
  return {part(x), part(y), part(sigma), part(color), part(on)};
}

Tensor Lights::glow(const Tensor& at_x, const Tensor& at_y, int frame) const {
  const auto each = [&](const Tensor& t) { return t.unsqueeze(-1).unsqueeze(-1); };
  const auto distance = (at_x.unsqueeze(1) - each(x)).square() + (at_y.unsqueeze(1) - each(y)).square();
  const auto shine = torch::exp(-0.5 * distance / each(sigma.square())) * each(on.select(2, frame - 1));
  return (shine.unsqueeze(2) * each(color)).sum(1);
}

Lights draw_lights(const SceneConfig& c, std::int64_t batch, std::int64_t height, std::int64_t width, Random& random) {
  if (c.light_probability <= 0) {
    return {};
  }
  Lights lights;
  const double side = static_cast<double>(std::min(height, width));
  lights.x = random.uniform({batch, kLights}, 0, static_cast<double>(width));
  lights.y = random.uniform({batch, kLights}, 0, static_cast<double>(height));
  lights.sigma = random.log_uniform({batch, kLights}, 0.03 * side, 0.2 * side);
  lights.color = random.uniform({batch, kLights, 1}, 0.3, 0.9);
  lights.color = lights.color * random.uniform({batch, kLights, 3}, 0.7, 1.0);
  const auto lit = random.chance({batch, kLights, 1}, c.light_probability).to(torch::kFloat32);
  const auto second = random.chance({batch, kLights, 1}, 0.5).to(torch::kFloat32);
  lights.on = lit * torch::cat({1 - second, second}, 2);
  return lights;
}

Tensor motion_blur(const Tensor& image, const Tensor& vx, const Tensor& vy, const Tensor& shutter) {
  const auto active = (shutter > 0).nonzero().squeeze(1);
  if (active.size(0) == 0) {
    return image;
  }
  constexpr int kTaps = 7;
  const std::int64_t height = image.size(2), width = image.size(3);
  const auto part = image.index_select(0, active);
  const auto open = shutter.index_select(0, active).view({-1, 1, 1});
  const auto dx = vx.index_select(0, active) * open, dy = vy.index_select(0, active) * open;
  const auto x = torch::arange(width, dx.options()).view({1, 1, width});
  const auto y = torch::arange(height, dx.options()).view({1, height, 1});
  auto sum = torch::zeros_like(part);
  for (int tap = 0; tap < kTaps; ++tap) {
    const double share = static_cast<double>(tap) / (kTaps - 1) - 0.5;
    const auto grid =
        torch::stack({(x + share * dx) * (2.0 / std::max<double>(1, static_cast<double>(width - 1))) - 1,
                      (y + share * dy) * (2.0 / std::max<double>(1, static_cast<double>(height - 1))) - 1},
                     -1);
    sum += F::grid_sample(
        part, grid, F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kBorder).align_corners(true));
  }
  return image.index_copy(0, active, sum / kTaps);
}

Tensor defocus(const Tensor& image, const Tensor& sigma_px) {
  const auto active = (sigma_px > 0.05).nonzero().squeeze(1);
  if (active.size(0) == 0) {
    return image;
  }
  constexpr std::int64_t kRadius = 4;
  const std::int64_t count = active.size(0), height = image.size(2), width = image.size(3);
  const auto offset = torch::arange(-kRadius, kRadius + 1, image.options()).view({1, -1});
  auto kernel = torch::exp(-0.5 * (offset / sigma_px.index_select(0, active).view({-1, 1})).square());
  kernel = (kernel / kernel.sum(1, true)).repeat_interleave(3, 0).unsqueeze(1).unsqueeze(1);
  auto planes = image.index_select(0, active).view({1, count * 3, height, width});
  planes = F::pad(planes, F::PadFuncOptions({kRadius, kRadius, kRadius, kRadius}).mode(torch::kReplicate));
  planes = F::conv2d(planes, kernel, F::Conv2dFuncOptions().groups(count * 3));
  planes = F::conv2d(planes, kernel.transpose(2, 3), F::Conv2dFuncOptions().groups(count * 3));
  return image.index_copy(0, active, planes.view({count, 3, height, width}));
}

Tensor expose(const Tensor& image, const Tensor& gain, const Tensor& gamma, const Tensor& noise) {
  const auto lit = image.clamp(1e-4, 1).pow(gamma.view({-1, 1, 1, 1})) * gain.view({-1, 3, 1, 1});
  return ((lit + noise) * 255.0).round().clamp(0, 255).to(torch::kUInt8);
}

}  // namespace ajna::synth
