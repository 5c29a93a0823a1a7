// SPDX-License-Identifier: MIT
#include "ajna/synth/pair_generator.hpp"

#include <cmath>
#include <string>
#include <tuple>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/synth/photometric.hpp"
#include "ajna/synth/random.hpp"
#include "ajna/synth/scene.hpp"

namespace ajna::synth {
namespace {

using torch::Tensor;

/// On a CPU the planes of this many scenes stay in the second-level cache; a GPU takes the whole batch at once.
constexpr std::int64_t kScenesPerChunk = 2;

constexpr double kFinestDetail = 1.3;  // texture pixels per image pixel that still show in full contrast

/// Coverage of each layer at canonical points [B * L, H, W]: 1 inside, 0 outside, one pixel of transition.
Tensor coverage(const Scene& s, const Points& at) {
  const auto row = [&](const Tensor& x) { return x.reshape({s.batch * s.layers, 1, 1}); };
  const auto radius = row(s.place.radius);
  const auto distance =
      s.shapes.signed_distance((at.x - row(s.place.center_x)) / radius, (at.y - row(s.place.center_y)) / radius);
  auto alpha = ((distance * radius + 0.5).clamp(0, 1) * row(s.present)).view({s.batch, s.layers, s.height, s.width});
  alpha.select(1, 0).fill_(1.0);  // the background is everywhere
  if (s.geometry && s.geometry->horizon_y.defined()) {
    const auto y = at.y.view({s.batch, s.layers, s.height, s.width}).select(1, 1);
    alpha.select(1, 1).copy_((y - s.geometry->horizon_y.view({-1, 1, 1}) + 0.5).clamp(0, 1));
  }
  return alpha;
}

/// Colour of each layer at canonical points in frame 1 or 2, [B, L, 3, H, W].
Tensor colors(const Scene& s, const TextureBank& bank, const Points& at, int frame) {
  auto x = at.x.view({s.batch, s.layers, s.height, s.width}), y = at.y.view_as(x);
  const auto p = [&](std::int64_t k) { return s.look.affine.select(2, k).view({s.batch, s.layers, 1, 1}); };
  Tensor contrast;
  if (s.geometry) {
    const auto texture = on_planes(*s.geometry, x, y);
    x = texture.q_u;
    y = texture.q_v;
    // Where a texture is too dense for the pixels it fades to grey instead of flickering.
    const auto scale = (p(0).square() + p(1).square()).sqrt();
    contrast = (kFinestDetail / (scale * texture.density)).clamp(0, 1).unsqueeze(2);
  }
  auto texels = bank.sample(s.look.index, p(0) * x - p(1) * y + p(2), p(1) * x + p(0) * y + p(3));
  if (contrast.defined()) {
    texels = (texels - 0.5) * contrast + 0.5;
  }
  const auto channel = [&](const Tensor& v) { return v.view({s.batch, s.layers, 3, 1, 1}); };
  const auto color = (texels * channel(s.look.gain) + channel(s.look.bias)).clamp(0, 1);
  return s.look.lit.defined() ? color * s.look.lit.select(2, frame - 1).view({s.batch, s.layers, 1, 1, 1}) : color;
}

struct Rendered {
  Tensor image;  // float [B, 3, H, W] in [0, 1]
  Tensor top;    // int64 [B, H, W]: front-most layer
};

/// Composite back to front; layer L - 1 is nearest.
Rendered render(const Scene& s, const TextureBank& bank, const Points& at, int frame) {
  const auto alpha = coverage(s, at), color = colors(s, bank, at, frame);
  Rendered out{color.select(1, 0).contiguous(),
               torch::zeros({s.batch, s.height, s.width}, alpha.options().dtype(torch::kInt64))};
  for (std::int64_t layer = 1; layer < s.layers; ++layer) {
    const auto a = alpha.select(1, layer);
    out.image = torch::lerp(out.image, color.select(1, layer), a.unsqueeze(1).expand_as(out.image));
    out.top.masked_fill_(a > 0.5, layer);
  }
  if (s.lights.x.defined()) {
    const auto on_background = [&](const Tensor& x) {
      return x.expand({s.batch * s.layers, s.height, s.width})
          .view({s.batch, s.layers, s.height, s.width})
          .select(1, 0);
    };
    out.image = (out.image + s.lights.glow(on_background(at.x), on_background(at.y), frame)).clamp(0, 1);
  }
  return out;
}

/// Is the point that `top` shows at each pixel of frame 1 behind a nearer layer, or outside the image, in frame 2?
Tensor occluded(const Scene& s, const Tensor& top, const Points& target) {
  const auto spread = [&](const Tensor& x) {
    return x.unsqueeze(1).expand({s.batch, s.layers, s.height, s.width}).reshape({-1, s.height, s.width});
  };
  const auto alpha = coverage(s, s.motion.to_frame1({spread(target.x), spread(target.y)}));
  const auto order = torch::arange(s.layers, top.options()).view({1, -1, 1, 1});
  const auto hidden = (alpha > 0.5).logical_and(order > top.unsqueeze(1)).any(1);
  const auto outside = (target.x < -0.5)
                           .logical_or(target.x > static_cast<double>(s.width) - 0.5)
                           .logical_or(target.y < -0.5)
                           .logical_or(target.y > static_cast<double>(s.height) - 0.5);
  return hidden.logical_or(outside);
}

/// Pixels with a 4-neighbour of another layer whose flow differs by more than `threshold_px`.
Tensor boundaries(const Tensor& top, const Tensor& flow, double threshold_px) {
  auto result = torch::zeros_like(top, torch::kBool);
  for (const std::int64_t axis : {1, 2}) {
    const std::int64_t n = top.size(axis);
    if (n < 2) {
      continue;
    }
    const auto apart = top.slice(axis, 0, n - 1).ne(top.slice(axis, 1, n));
    const auto step = (flow.slice(axis + 1, 0, n - 1) - flow.slice(axis + 1, 1, n)).square().sum(1).sqrt();
    const auto edge = apart.logical_and(step > threshold_px);
    result.slice(axis, 0, n - 1).logical_or_(edge);
    result.slice(axis, 1, n).logical_or_(edge);
  }
  return result;
}

PairBatch render_pair(const Scene& s, const TextureBank& bank, const SceneConfig& config, const Tensor& noise1,
                      const Tensor& noise2) {
  const auto options = s.present.options();
  const auto x = torch::arange(s.width, options).view({1, 1, -1}).expand({1, s.height, s.width});
  const auto y = torch::arange(s.height, options).view({1, -1, 1}).expand({1, s.height, s.width});
  const std::int64_t rows = s.batch * s.layers;

  const auto first = render(s, bank, {x.expand({rows, -1, -1}), y.expand({rows, -1, -1})}, 1);
  const auto seen = s.motion.to_frame1({x, y});
  const auto second = render(s, bank, seen, 2);

  const auto target = s.motion.per_pixel(first.top, s.layers).to_frame2({x, y});
  PairBatch pair;
  pair.flow = torch::stack({target.x - x, target.y - y}, 1).contiguous();
  pair.occlusion = occluded(s, first.top, target).unsqueeze(1);
  pair.motion_boundary = boundaries(first.top, pair.flow, config.motion_boundary_px).unsqueeze(1);
  pair.layer1 = first.top.to(torch::kUInt8).unsqueeze(1);
  pair.layer2 = second.top.to(torch::kUInt8).unsqueeze(1);

  const auto pick = [&](const Tensor& plane) {
    return plane.view({s.batch, s.layers, s.height, s.width}).gather(1, second.top.unsqueeze(1)).squeeze(1);
  };
  const auto image1 = motion_blur(first.image, pair.flow.select(1, 0), pair.flow.select(1, 1), s.camera.shutter);
  const auto image2 = motion_blur(second.image, x - pick(seen.x), y - pick(seen.y), s.camera.shutter);
  pair.frame1 = expose(defocus(image1, s.camera.defocus_px), s.camera.gain1, s.camera.gamma1, noise1);
  pair.frame2 = expose(defocus(image2, s.camera.defocus_px), s.camera.gain2, s.camera.gamma2, noise2);
  return pair;
}

Tensor join(const std::vector<PairBatch>& parts, Tensor PairBatch::*member) {
  std::vector<Tensor> tensors;
  tensors.reserve(parts.size());
  for (const auto& part : parts) {
    tensors.push_back(part.*member);
  }
  return torch::cat(tensors, 0);
}

const SceneConfig& validated(const SceneConfig& config) {
  validate(config);
  return config;
}

}  // namespace

PairGenerator::PairGenerator(const SceneConfig& config, std::uint64_t bank_seed, const torch::Device& device,
                             const std::optional<Tensor>& photos)
    : config_(validated(config)),
      device_(device),
      bank_(std::make_shared<TextureBank>(config.bank_size, config.texture_size, bank_seed, device, photos,
                                          TextureMix{config.flat_texture_share, config.repetitive_texture_share})) {}

PairGenerator::PairGenerator(const SceneConfig& config, const PairGenerator& other)
    : config_(validated(config)), device_(other.device_), bank_(other.bank_) {
  const auto textures = [](const SceneConfig& c) {
    return std::tuple(c.bank_size, c.texture_size, c.flat_texture_share, c.repetitive_texture_share);
  };
  if (textures(config) != textures(other.config_)) {
    throw_invalid(
        "scenes whose bank_size, texture_size, flat_texture_share or repetitive_texture_share differ cannot share "
        "textures: make a generator of its own");
  }
}

PairBatch PairGenerator::generate(std::int64_t batch, std::int64_t height, std::int64_t width, std::uint64_t seed,
                                  double flow_scale) const {
  if (batch < 1 || height < 1 || width < 1) {
    throw_invalid("batch of " + std::to_string(batch) + " pairs of " + std::to_string(width) + "x" +
                  std::to_string(height) + ": give at least one pair of at least 1x1 pixels");
  }
  if (!std::isfinite(flow_scale) || flow_scale < 0) {
    throw_invalid("flow_scale = " + std::to_string(flow_scale) + ": give a finite number of at least 0");
  }
  const torch::NoGradGuard no_grad;
  SceneConfig scaled = config_;
  scaled.flow_mean_px *= flow_scale;
  scaled.flow_max_px *= flow_scale;

  const auto drawn = draw_scene(scaled, *bank_, batch, height, width, seed);
  const auto noise = device_normal({batch, 2, 3, height, width}, seed ^ 0x9E3779B97F4A7C15ULL, device_) *
                     drawn.camera.noise.to(device_).view({batch, 1, 1, 1, 1});

  const std::int64_t chunk = device_.is_cpu() ? kScenesPerChunk : batch;
  std::vector<PairBatch> parts;
  for (std::int64_t begin = 0; begin < batch; begin += chunk) {
    const std::int64_t end = std::min(batch, begin + chunk);
    const auto scene = drawn.slice(begin, end, device_);
    const auto window = noise.slice(0, begin, end);
    parts.push_back(render_pair(scene, *bank_, config_, window.select(1, 0), window.select(1, 1)));
  }
  return {join(parts, &PairBatch::frame1),    join(parts, &PairBatch::frame2),          join(parts, &PairBatch::flow),
          join(parts, &PairBatch::occlusion), join(parts, &PairBatch::motion_boundary), join(parts, &PairBatch::layer1),
          join(parts, &PairBatch::layer2)};
}

}  // namespace ajna::synth
