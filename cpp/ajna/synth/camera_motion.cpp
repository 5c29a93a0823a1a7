// SPDX-License-Identifier: MIT
#include "ajna/synth/camera_motion.hpp"

#include <cmath>
#include <vector>

namespace ajna::synth {
namespace {

using torch::Tensor;

/// The camera travels at most this part of the way to the nearest point in view, so that everything stays before it.
constexpr double kMaxApproach = 0.35;
constexpr double kMaxTurn = 0.3;    // rad per frame interval
constexpr double kLeverArm = 0.25;  // typical distance to the focus of expansion, in image widths
constexpr double kMaxSlope = 0.85;  // of a table, relative to the slope whose horizon is the image's upper edge
constexpr double kGrazing = 1e-3;   // inverse depths below this are at the horizon

double middle_depth(const SceneConfig& c) { return std::sqrt(c.depth_near * c.depth_far); }

/// Intrinsics K and their inverse, [B, 3, 3] float64.
Tensor intrinsics(const SceneGeometry& g, bool inverse) {
  const auto& f = g.focal_px;
  const auto one = torch::ones_like(f), zero = torch::zeros_like(f);
  const auto scale = inverse ? f.reciprocal() : f;
  const auto x = inverse ? -g.center_x / f : one * g.center_x, y = inverse ? -g.center_y / f : one * g.center_y;
  return torch::stack({scale, zero, x, zero, scale, y, zero, zero, one}, -1).view({-1, 3, 3});
}

/// [B, 3] -> [B, 3, 3]: cross-product matrix.
Tensor skew(const Tensor& w) {
  const auto x = w.select(1, 0), y = w.select(1, 1), z = w.select(1, 2), zero = torch::zeros_like(x);
  return torch::stack({zero, -z, y, z, zero, -x, -y, x, zero}, -1).view({-1, 3, 3});
}

}  // namespace

std::int64_t layer_count(const SceneConfig& c) {
  return c.layers + (c.camera != "off" && c.surface == "floor" ? 2 : 1);
}

Tensor SceneGeometry::inverse_depth(const Tensor& u, const Tensor& v) const {
  const auto f = focal_px.view({-1, 1});
  return plane.select(2, 0) * ((u - center_x) / f) + plane.select(2, 1) * ((v - center_y) / f) + plane.select(2, 2);
}

Tensor SceneGeometry::largest_inverse_depth() const {
  const auto reach_x = (0.5 * width_px / focal_px).view({-1, 1}), reach_y = (0.5 * height_px / focal_px).view({-1, 1});
  return plane.select(2, 2) + plane.select(2, 0).abs() * reach_x + plane.select(2, 1).abs() * reach_y;
}

SceneGeometry SceneGeometry::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  SceneGeometry part = *this;
  for (auto member :
       {&SceneGeometry::plane, &SceneGeometry::focal_px, &SceneGeometry::horizon_y, &SceneGeometry::floor_plane}) {
    if ((part.*member).defined()) {
      part.*member = (part.*member).slice(0, begin, end).to(device);
    }
  }
  return part;
}

SceneGeometry draw_geometry(const SceneConfig& c, std::int64_t batch, std::int64_t height, std::int64_t width,
                            Random& random) {
  SceneGeometry g;
  g.width_px = static_cast<double>(width);
  g.height_px = static_cast<double>(height);
  g.center_x = 0.5 * (g.width_px - 1);
  g.center_y = 0.5 * (g.height_px - 1);
  const auto wide = [](const Tensor& x) { return x.to(torch::kFloat64); };
  g.focal_px = wide(random.log_uniform({batch}, c.focal_min, c.focal_max)) * g.width_px;

  const auto drawn = wide(random.log_uniform({batch, c.layers}, c.depth_near, c.depth_far));
  auto depth = std::get<0>(drawn.sort(1, /*descending=*/true));
  const auto background = torch::ones({batch, 1}, torch::kFloat64);
  const auto tilt = wide(random.normal({batch, c.layers + 1, 2}, c.plane_tilt)).clamp(-0.5, 0.5);
  depth = torch::cat({background, depth}, 1);

  auto across = torch::cat({tilt, torch::ones({batch, c.layers + 1, 1}, torch::kFloat64)}, 2);
  if (c.surface == "table") {
    const auto lean = wide(random.uniform({batch}, 0, c.table_tilt_deg * kPi / 180.0)).view({batch, 1});
    // The bottom of the image is nearer. The same slope for all: planes on each other do not cross.
    const auto zero = torch::zeros_like(lean), one = torch::ones_like(lean);
    // Steeper, a tall image would see beyond the plane's horizon.
    const auto slope = torch::minimum(lean.tan(), kMaxSlope * 2.0 / g.height_px * g.focal_px.view({batch, 1}));
    across = torch::stack({zero, slope, one}, 2).expand({batch, c.layers + 1, 3});
  }
  g.plane = across / depth.unsqueeze(2);

  if (c.surface == "floor") {
    const auto pitch = wide(random.normal({batch}, 0.08)).clamp(-0.2, 0.2);
    const auto above = wide(random.log_uniform({batch}, 0.5, 2.0)) * c.camera_height;
    g.floor_plane = torch::stack({torch::zeros_like(pitch), pitch.cos(), pitch.sin()}, 1) / above.unsqueeze(1);
    g.horizon_y = (g.center_y - g.focal_px * pitch.tan()).to(torch::kFloat32);
    g.plane = torch::cat({g.plane.slice(1, 0, 1), g.floor_plane.unsqueeze(1), g.plane.slice(1, 1)}, 1);
  }
  return g;
}

CameraStep draw_camera_step(const SceneConfig& c, const SceneGeometry& g, const Tensor& magnitude_px, Random& random) {
  const std::int64_t batch = magnitude_px.size(0);
  const auto magnitude = magnitude_px.to(torch::kFloat64).view({batch, 1}), f = g.focal_px.view({batch, 1});
  const auto angle = random.uniform({batch}, 0, 2 * kPi).to(torch::kFloat64);
  const auto jitter = random.normal({batch, 3}).to(torch::kFloat64);
  const auto zero = torch::zeros_like(angle), one = torch::ones_like(angle);

  Tensor direction, arm = f;
  if (c.camera == "forward") {
    // Along the floor where there is one; with a little drift, so that the focus of expansion wanders.
    direction = torch::stack({zero, zero, one}, 1);
    if (g.floor_plane.defined()) {
      const auto slope = g.floor_plane.select(1, 2) / g.floor_plane.select(1, 1);
      direction = torch::stack({zero, -slope, one}, 1);
    }
    const auto drift = torch::tensor({0.12, 0.05, 0.0}, torch::kFloat64);
    direction = direction + jitter * drift;
    arm = torch::full_like(f, kLeverArm * g.width_px);
  } else if (c.camera == "any") {
    direction = jitter;
  } else {
    direction = torch::stack({angle.cos(), angle.sin(), 0.15 * jitter.select(1, 2)}, 1);
  }
  direction = direction / direction.norm(2, 1, /*keepdim=*/true).clamp_min(1e-9);

  auto distance = magnitude * middle_depth(c) / arm;
  const auto nearest = g.largest_inverse_depth().amax(1, /*keepdim=*/true);
  distance = torch::minimum(distance, kMaxApproach / nearest);

  CameraStep step;
  step.translation = direction * distance;
  auto rotation = random.normal({batch, 3}, c.camera_rotation).to(torch::kFloat64) * (magnitude / f);
  if (c.camera == "fixate") {
    // Eq. 14 at the image centre vanishes for Omega = (V_y, -V_x, 0) / Z.
    const auto share = random.uniform({batch, 1}, 0.5, 1.0).to(torch::kFloat64);
    const auto& v = step.translation;
    rotation = rotation + share * torch::stack({v.select(1, 1), -v.select(1, 0), zero}, 1);
  }
  const auto turn = rotation.norm(2, 1, /*keepdim=*/true);
  step.rotation = rotation * (kMaxTurn / turn.clamp_min(kMaxTurn));
  return step;
}

Tensor step_homographies(const SceneGeometry& g, const CameraStep& step) {
  const auto inverse_turn = torch::linalg_matrix_exp(-skew(step.rotation)).unsqueeze(1);
  const auto eye = torch::eye(3, g.plane.options()).view({1, 1, 3, 3});
  const auto shift = eye - step.translation.view({-1, 1, 3, 1}) * g.plane.unsqueeze(2);
  return intrinsics(g, false).unsqueeze(1).matmul(inverse_turn).matmul(shift).matmul(intrinsics(g, true).unsqueeze(1));
}

PlaneTexture on_planes(const SceneGeometry& g, const Tensor& u, const Tensor& v) {
  const std::int64_t batch = u.size(0);
  const auto f = g.focal_px.view({batch, 1});
  // Axes on the plane: e1 is the image's x axis laid on it, e2 completes it.
  const auto normal = g.plane / g.plane.norm(2, 2, /*keepdim=*/true);
  const auto e_x = torch::tensor({1.0, 0.0, 0.0}, normal.options()).view({1, 1, 3});
  auto e1 = e_x - normal.select(2, 0).unsqueeze(2) * normal;
  e1 = e1 / e1.norm(2, 2, /*keepdim=*/true);
  const auto e2 = torch::linalg_cross(normal, e1, 2);
  // Moving the ray by dx moves the point by (dx - x (m . dx) / zeta) / zeta, at most about (1 + |m_xy| / zeta) / zeta.
  const auto lean = g.plane.slice(2, 0, 2).norm(2, 2);
  const auto nearest = g.largest_inverse_depth();
  const auto unit = nearest / (1 + lean / nearest);

  const auto each = [&](const Tensor& x) { return x.to(torch::kFloat32).view({batch, -1, 1, 1}); };
  const auto x = (u - g.center_x) / each(f), y = (v - g.center_y) / each(f);
  const auto along = [&](const Tensor& axis) {
    return each(axis.select(2, 0)) * x + each(axis.select(2, 1)) * y + each(axis.select(2, 2));
  };
  const auto depth = (along(g.plane)).clamp_min(kGrazing).reciprocal();
  const auto scale = depth * each(f * unit);
  PlaneTexture texture;
  texture.q_u = along(e1) * scale;
  texture.q_v = along(e2) * scale;
  texture.density = depth * each(unit) * (1 + each(lean) * depth);
  return texture;
}

}  // namespace ajna::synth
