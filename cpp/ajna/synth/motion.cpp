// SPDX-License-Identifier: MIT
#include "ajna/synth/motion.hpp"

#include <cmath>
#include <vector>

namespace ajna::synth {
namespace {

using torch::Tensor;

constexpr std::int64_t kWaves = 2;

/// Parameter k of each row (or pixel), shaped to broadcast against [R, H, W] planes.
Tensor param(const Tensor& params, std::int64_t k) {
  const auto column = params.select(-1, k);
  return column.dim() == 1 ? column.view({-1, 1, 1}) : column;
}

Points apply_homography(const Tensor& g, const Points& p, bool projective) {
  auto x = param(g, 0) * p.x + param(g, 1) * p.y + param(g, 2);
  auto y = param(g, 3) * p.x + param(g, 4) * p.y + param(g, 5);
  if (projective) {
    const auto scale = (param(g, 6) * p.x + param(g, 7) * p.y + param(g, 8)).reciprocal();
    return {x * scale, y * scale};
  }
  return {x, y};
}

Points wave_field(const Tensor& waves, const Points& q) {
  Points sum;
  for (std::int64_t k = 0; k < waves.size(-2); ++k) {
    const auto wave = waves.select(-2, k);
    const auto phase = torch::sin(param(wave, 2) * q.x + param(wave, 3) * q.y + param(wave, 4));
    const Points term{param(wave, 0) * phase, param(wave, 1) * phase};
    sum = sum.x.defined() ? Points{sum.x + term.x, sum.y + term.y} : term;
  }
  return sum;
}

/// Displacement magnitudes by the chosen distribution, pixels.
Tensor draw_magnitude(const SceneConfig& c, torch::IntArrayRef shape, Random& random) {
  if (c.flow_distribution == "uniform") {
    return random.uniform(shape, 0, c.flow_max_px);
  }
  if (c.flow_distribution == "log_uniform") {
    return random.log_uniform(shape, 0.1, std::max(0.2, c.flow_max_px));
  }
  return (-(1.0 - random.uniform(shape)).clamp_min(1e-12).log() * c.flow_mean_px).clamp_max(c.flow_max_px);
}

/// Homographies [B, L, 3, 3] about the layer centres: translate(t) * perspective * rotate-and-scale.
Tensor compose(const LayerPlacement& place, const Tensor& tx, const Tensor& ty, const Tensor& angle,
               const Tensor& scale, const Tensor& px, const Tensor& py) {
  const auto zero = torch::zeros_like(tx), one = torch::ones_like(tx);
  const auto matrix = [](const std::vector<Tensor>& v) {
    return torch::stack(v, -1).view({-1, 3, 3}).to(torch::kFloat64);
  };
  const auto to_center = matrix({one, zero, -place.center_x, zero, one, -place.center_y, zero, zero, one});
  const auto back = matrix({one, zero, place.center_x + tx, zero, one, place.center_y + ty, zero, zero, one});
  const auto c = angle.cos() * scale, s = angle.sin() * scale;
  const auto turn = matrix({c, -s, zero, s, c, zero, zero, zero, one});
  const auto tilt = matrix({one, zero, zero, zero, one, zero, px, py, one});
  return back.matmul(tilt).matmul(turn).matmul(to_center);
}

/// Homographies [R, 3, 3] float64 and their inverses, with a last element of 1, as [R, 9] float32.
void set_homographies(LayerMotion& motion, const Tensor& g) {
  const auto rows = [](const Tensor& m) {
    return (m / m.select(1, 2).select(1, 2).view({-1, 1, 1})).reshape({-1, 9}).to(torch::kFloat32);
  };
  motion.forward = rows(g);
  motion.backward = rows(torch::linalg_inv(motion.forward.view({-1, 3, 3}).to(torch::kFloat64)));
}

}  // namespace

Points LayerMotion::to_frame1(const Points& y) const {
  Points q = apply_homography(backward, y, projective);
  if (!nonrigid) {
    return q;
  }
  const Points n = wave_field(waves, q);
  return {q.x + n.x, q.y + n.y};
}

Points LayerMotion::to_frame2(const Points& x) const {
  Points q = x;
  if (nonrigid) {
    for (int i = 0; i < kIterations; ++i) {
      const Points n = wave_field(waves, q);
      q = {x.x - n.x, x.y - n.y};
    }
  }
  return apply_homography(forward, q, projective);
}

LayerMotion LayerMotion::per_pixel(const Tensor& row, std::int64_t layers) const {
  const auto sizes = row.sizes();
  const auto first = torch::arange(sizes[0], row.options()).view({-1, 1, 1}) * layers;
  const auto index = (row + first).reshape({-1});
  LayerMotion chosen;
  chosen.projective = projective;
  chosen.nonrigid = nonrigid;
  chosen.forward = forward.index_select(0, index).view({sizes[0], sizes[1], sizes[2], 9});
  chosen.backward = backward.index_select(0, index).view({sizes[0], sizes[1], sizes[2], 9});
  chosen.waves = waves.index_select(0, index).view({sizes[0], sizes[1], sizes[2], waves.size(1), 5});
  return chosen;
}

LayerMotion LayerMotion::relative_to(const Tensor& still, std::int64_t layers) const {
  const auto g = forward.to(torch::kFloat64).view({-1, layers, 3, 3});
  const auto row = still.clamp_min(0).view({-1, 1, 1, 1}).expand({-1, 1, 3, 3});
  const auto left = torch::linalg_solve(g.gather(1, row).expand_as(g), g);
  LayerMotion relative = *this;
  set_homographies(relative, torch::where(still.view({-1, 1, 1, 1}) >= 0, left, g).reshape({-1, 3, 3}));
  return relative;
}

LayerMotion LayerMotion::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  LayerMotion part;
  part.forward = forward.slice(0, begin, end).to(device);
  part.backward = backward.slice(0, begin, end).to(device);
  part.waves = waves.slice(0, begin, end).to(device);
  part.projective = projective;
  part.nonrigid = nonrigid;
  return part;
}

LayerMotion draw_motion(const SceneConfig& c, const LayerPlacement& place, std::int64_t height, std::int64_t width,
                        Random& random, const SceneGeometry* geometry, Random* extra) {
  const std::int64_t batch = place.radius.size(0), layers = place.radius.size(1);
  auto magnitude = draw_magnitude(c, {batch, layers}, random);
  magnitude.select(1, 0) *= c.background_ratio;
  magnitude.select(1, 0) *= random.chance({batch}, c.static_probability).logical_not().to(torch::kFloat32);
  const auto direction = random.uniform({batch, layers}, 0, 2 * kPi);
  auto tx = magnitude * direction.cos(), ty = magnitude * direction.sin();

  // Rotation and zoom move the rim of what is seen of the layer by a share of its displacement.
  const auto rim = place.extent.clamp_min(0.1 * static_cast<double>(std::min(height, width)));
  auto angle = (random.normal({batch, layers}, c.rotation_zoom) * magnitude / rim).clamp(-0.5, 0.5);
  auto scale = (random.normal({batch, layers}, c.rotation_zoom) * magnitude / rim).clamp(-0.35, 0.35).exp();

  bool projective = random.number() < c.perspective_probability;
  auto px = torch::zeros({batch, layers}), py = torch::zeros({batch, layers});
  if (projective) {
    px = (random.normal({batch, layers}, 0.5 * c.rotation_zoom) * magnitude / rim).clamp(-0.15, 0.15) / rim;
    py = (random.normal({batch, layers}, 0.5 * c.rotation_zoom) * magnitude / rim).clamp(-0.15, 0.15) / rim;
  }

  auto g = compose(place, tx, ty, angle, scale, px, py).view({batch, layers, 3, 3});
  const auto background = g.slice(1, 0, 1);
  // Layers ride on the camera's motion; some move with the background exactly, and in parallax scenes all move along
  // its translation, nearer (later) ones faster.
  auto own = torch::matmul(g, background);
  own.select(1, 0).copy_(g.select(1, 0));
  const auto attached = random.chance({batch, layers, 1, 1}, c.attached_probability);
  own = torch::where(attached, background.expand_as(own), own);
  const auto depth_order = random.uniform({batch, layers}, 0.2, 1.5).cumsum(1);
  auto parallax = background.expand_as(own).clone();
  parallax.select(2, 0).select(2, 2) += (tx.slice(1, 0, 1) * depth_order).to(torch::kFloat64);
  parallax.select(2, 1).select(2, 2) += (ty.slice(1, 0, 1) * depth_order).to(torch::kFloat64);
  parallax.select(1, 0).copy_(g.select(1, 0));
  own = torch::where(random.chance({batch, 1, 1, 1}, c.parallax_probability), parallax, own);

  if (geometry != nullptr) {
    Random& more = extra != nullptr ? *extra : random;
    auto alone = more.chance({batch, layers, 1, 1}, c.independent_probability);
    alone.slice(1, 0, layers - c.layers).fill_(false);  // the background and the floor do not move by themselves
    const auto still = torch::eye(3, g.options()).expand_as(g);
    const auto step = draw_camera_step(c, *geometry, magnitude.select(1, 0), more);
    own = step_homographies(*geometry, step).matmul(torch::where(alone, g, still));
    projective = true;
  }

  LayerMotion motion;
  motion.projective = projective;
  set_homographies(motion, own.reshape({-1, 3, 3}));

  motion.nonrigid = random.number() < c.nonrigid_probability;
  const std::int64_t rows = batch * layers;
  const auto length = (rim.view({rows, 1}) * random.uniform({rows, kWaves}, 0.8, 2.5)).clamp_min(8.0);
  const auto turn = random.uniform({rows, kWaves}, 0, 2 * kPi), lean = random.uniform({rows, kWaves}, 0, 2 * kPi);
  const auto frequency = 2 * kPi / length;
  const auto limit = LayerMotion::kMaxGradient / static_cast<double>(kWaves) / frequency;
  const auto amplitude = torch::minimum(0.3 * magnitude.view({rows, 1}) * random.uniform({rows, kWaves}), limit) *
                         random.chance({rows, 1}, motion.nonrigid ? 0.5 : 0.0).to(torch::kFloat32);
  motion.waves = torch::stack({amplitude * lean.cos(), amplitude * lean.sin(), frequency * turn.cos(),
                               frequency * turn.sin(), random.uniform({rows, kWaves}, 0, 2 * kPi)},
                              -1);
  return motion;
}

}  // namespace ajna::synth
