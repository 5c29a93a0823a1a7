// SPDX-License-Identifier: MIT
#include "ajna/synth/color.hpp"

#include <vector>

namespace ajna::synth {
namespace {

using torch::Tensor;

}  // namespace

Tensor turn_hue(const Tensor& image, const Tensor& turn, const Tensor& factor) {
  const auto value = image.amax(1), chroma = value - image.amin(1);
  const auto red = image.select(1, 0), green = image.select(1, 1), blue = image.select(1, 2);
  const auto safe = chroma.clamp_min(1e-8);
  // Hue in sixths of the circle, by the largest channel.
  auto hue = torch::where(value == red, (green - blue) / safe,
                          torch::where(value == green, (blue - red) / safe + 2, (red - green) / safe + 4));
  hue = hue + 6 * turn.view({-1, 1, 1});
  const auto saturation = (chroma / value.clamp_min(1e-8) * factor.view({-1, 1, 1})).clamp(0, 1);
  std::vector<Tensor> channels;
  channels.reserve(3);
  for (const double sixth : {5.0, 3.0, 1.0}) {
    const auto k = (hue + sixth).remainder(6.0);
    channels.push_back(value * (1 - saturation * torch::minimum(k, 4 - k).clamp(0, 1)));
  }
  return torch::stack(channels, 1);
}

Tensor change_color(const Tensor& image, const Tensor& mean, const ColorChange& change) {
  const auto each = [](const Tensor& x) { return x.view({-1, 1, 1, 1}); };
  auto result = (image + each(change.brightness)).clamp(0, 1);
  const auto center = (mean + change.brightness.view({-1, 1})).clamp(0, 1).view({-1, 3, 1, 1});
  result = ((result - center) * each(change.contrast) + center).clamp(0, 1);
  result = turn_hue(result, change.hue, change.saturation).clamp(0, 1);
  return result.pow(each(change.gamma));
}

}  // namespace ajna::synth
