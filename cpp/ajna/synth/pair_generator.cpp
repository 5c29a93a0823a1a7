// SPDX-License-Identifier: MIT
#include "ajna/synth/pair_generator.hpp"

#include <cmath>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/synth/motion.hpp"
#include "ajna/synth/photometric.hpp"
#include "ajna/synth/shapes.hpp"

namespace ajna::synth {
namespace {

using torch::Tensor;

constexpr double kPi = 3.14159265358979323846;

/// On a CPU the planes of this many scenes stay in the second-level cache; a GPU takes the whole batch at once.
constexpr std::int64_t kScenesPerChunk = 2;

/// How a layer looks up its texture: texture pixel = scale * rotation * image pixel + offset, then gain and bias.
struct Appearance {
  Tensor index;       // int64 [B, L] into the bank
  Tensor affine;      // [B, L, 4]: scale * cos, scale * sin, offset u, offset v
  Tensor gain, bias;  // [B, L, 3]

  [[nodiscard]] Appearance slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
    const auto part = [&](const Tensor& x) { return x.slice(0, begin, end).to(device); };
    return {part(index), part(affine), part(gain), part(bias)};
  }
};

/// Everything that was drawn for the scenes of a chunk, on the device.
struct Scene {
  std::int64_t batch, layers, height, width;
  LayerPlacement place;  // [B, L]
  Tensor present;        // [B, L] float 0 or 1
  ShapeSet shapes;
  LayerMotion motion;
  Appearance look;
  CameraEffects camera;
};

LayerPlacement draw_placement(const SceneConfig& c, const ShapeSet& shapes, std::int64_t batch, std::int64_t layers,
                              std::int64_t height, std::int64_t width, Random& random) {
  const double side = static_cast<double>(std::min(height, width));
  LayerPlacement place;
  place.center_x = random.uniform({batch, layers}, -0.05, 1.05) * static_cast<double>(width - 1);
  place.center_y = random.uniform({batch, layers}, -0.05, 1.05) * static_cast<double>(height - 1);
  place.radius = random.log_uniform({batch, layers}, c.min_size * side, c.max_size * side + 1e-9);
  // The background turns about the image centre.
  place.center_x.select(1, 0).fill_(0.5 * static_cast<double>(width - 1));
  place.center_y.select(1, 0).fill_(0.5 * static_cast<double>(height - 1));
  // The background and plates fill the image; a motion that is moderate at their radius would be wild at its corners.
  const double diagonal = std::hypot(static_cast<double>(height), static_cast<double>(width));
  place.extent = torch::where(shapes.unbounded().view({batch, layers}), torch::full_like(place.radius, diagonal),
                              place.radius.clone());
  place.extent.select(1, 0).fill_(0.5 * diagonal);
  return place;
}

Appearance draw_appearance(const SceneConfig& c, const TextureBank& bank, std::int64_t batch, std::int64_t layers,
                           Random& random) {
  const auto procedural = random.integers({batch, layers}, std::max<std::int64_t>(1, bank.procedural_count()));
  Appearance look;
  look.index = procedural;
  if (bank.photo_count() > 0) {
    const auto photo = bank.procedural_count() + random.integers({batch, layers}, bank.photo_count());
    look.index = torch::where(random.chance({batch, layers}, c.photo_probability), photo, procedural);
  }
  const auto turn = random.uniform({batch, layers}, 0, 2 * kPi), scale = random.log_uniform({batch, layers}, 0.4, 1.2);
  const double size = static_cast<double>(bank.size());
  look.affine = torch::stack({scale * turn.cos(), scale * turn.sin(), random.uniform({batch, layers}, 0, 2 * size),
                              random.uniform({batch, layers}, 0, 2 * size)},
                             -1);
  look.gain = random.uniform({batch, layers, 1}, 0.5, 1.1) * random.uniform({batch, layers, 3}, 0.85, 1.15);
  look.bias = random.uniform({batch, layers, 1}, -0.1, 0.25) + random.normal({batch, layers, 3}, 0.03);
  return look;
}

/// Coverage of each layer at canonical points [B * L, H, W]: 1 inside, 0 outside, one pixel of transition.
Tensor coverage(const Scene& s, const Points& at) {
  const auto row = [&](const Tensor& x) { return x.reshape({s.batch * s.layers, 1, 1}); };
  const auto radius = row(s.place.radius);
  const auto distance =
      s.shapes.signed_distance((at.x - row(s.place.center_x)) / radius, (at.y - row(s.place.center_y)) / radius);
  auto alpha = ((distance * radius + 0.5).clamp(0, 1) * row(s.present)).view({s.batch, s.layers, s.height, s.width});
  alpha.select(1, 0).fill_(1.0);  // the background is everywhere
  return alpha;
}

Tensor colors(const Scene& s, const TextureBank& bank, const Points& at) {
  const auto x = at.x.view({s.batch, s.layers, s.height, s.width}), y = at.y.view_as(x);
  const auto p = [&](std::int64_t k) { return s.look.affine.select(2, k).view({s.batch, s.layers, 1, 1}); };
  const auto texels = bank.sample(s.look.index, p(0) * x - p(1) * y + p(2), p(1) * x + p(0) * y + p(3));
  const auto channel = [&](const Tensor& v) { return v.view({s.batch, s.layers, 3, 1, 1}); };
  return (texels * channel(s.look.gain) + channel(s.look.bias)).clamp(0, 1);
}

struct Rendered {
  Tensor image;  // float [B, 3, H, W] in [0, 1]
  Tensor top;    // int64 [B, H, W]: front-most layer
};

/// Composite back to front; layer L - 1 is nearest.
Rendered render(const Scene& s, const TextureBank& bank, const Points& at) {
  const auto alpha = coverage(s, at), color = colors(s, bank, at);
  Rendered out{color.select(1, 0).contiguous(),
               torch::zeros({s.batch, s.height, s.width}, alpha.options().dtype(torch::kInt64))};
  for (std::int64_t layer = 1; layer < s.layers; ++layer) {
    const auto a = alpha.select(1, layer);
    out.image = torch::lerp(out.image, color.select(1, layer), a.unsqueeze(1).expand_as(out.image));
    out.top.masked_fill_(a > 0.5, layer);
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

  const auto first = render(s, bank, {x.expand({rows, -1, -1}), y.expand({rows, -1, -1})});
  const auto seen = s.motion.to_frame1({x, y});
  const auto second = render(s, bank, seen);

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

/// Normal deviates on the device from a seeded generator of its own.
Tensor draw_noise(torch::IntArrayRef shape, std::uint64_t seed, const torch::Device& device) {
  auto generator = at::globalContext().defaultGenerator(device).clone();
  generator.set_current_seed(seed);
  return torch::randn(shape, generator, torch::TensorOptions().device(device));
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
      bank_(config.bank_size, config.texture_size, bank_seed, device, photos) {}

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

  Random random(seed);
  const std::int64_t layers = config_.layers + 1;
  const ShapeSet shapes(config_, batch * layers, random);
  const auto place = draw_placement(config_, shapes, batch, layers, height, width, random);
  const auto present = random.chance({batch, layers}, config_.layer_probability).to(torch::kFloat32);
  const auto motion = draw_motion(scaled, place, height, width, random);
  const auto look = draw_appearance(config_, bank_, batch, layers, random);
  const auto camera = draw_camera_effects(config_, batch, random);
  const auto noise = draw_noise({batch, 2, 3, height, width}, seed ^ 0x9E3779B97F4A7C15ULL, device_) *
                     camera.noise.to(device_).view({batch, 1, 1, 1, 1});

  const std::int64_t chunk = device_.is_cpu() ? kScenesPerChunk : batch;
  std::vector<PairBatch> parts;
  for (std::int64_t begin = 0; begin < batch; begin += chunk) {
    const std::int64_t end = std::min(batch, begin + chunk);
    const auto part = [&](const Tensor& x) { return x.slice(0, begin, end).to(device_); };
    const Scene scene{end - begin,
                      layers,
                      height,
                      width,
                      {part(place.center_x), part(place.center_y), part(place.radius), part(place.extent)},
                      part(present),
                      shapes.slice(begin * layers, end * layers, device_),
                      motion.slice(begin * layers, end * layers, device_),
                      look.slice(begin, end, device_),
                      camera.slice(begin, end, device_)};
    const auto window = noise.slice(0, begin, end);
    parts.push_back(render_pair(scene, bank_, config_, window.select(1, 0), window.select(1, 1)));
  }
  return {join(parts, &PairBatch::frame1),    join(parts, &PairBatch::frame2),          join(parts, &PairBatch::flow),
          join(parts, &PairBatch::occlusion), join(parts, &PairBatch::motion_boundary), join(parts, &PairBatch::layer1),
          join(parts, &PairBatch::layer2)};
}

}  // namespace ajna::synth
