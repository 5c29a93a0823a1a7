// SPDX-License-Identifier: MIT
#include "ajna/synth/scene.hpp"

#include <algorithm>
#include <cmath>

namespace ajna::synth {
namespace {

using torch::Tensor;

constexpr std::uint64_t kExtraStream = 0xD1B54A32D192ED03ULL;  // any odd constant: a stream apart from the seed's own

/// Centres and sizes of what stands before a moving camera: a layer twice as far is half as large, and where there is a
/// floor it stands on it.
void place_in_depth(const SceneConfig& c, const SceneGeometry& g, const ShapeSet& shapes, LayerPlacement& place,
                    Random& extra) {
  const std::int64_t batch = place.radius.size(0), layers = place.radius.size(1);
  const auto upright = shapes.upright().view({batch, layers});
  auto inverse_depth = g.inverse_depth(place.center_x, place.center_y).to(torch::kFloat32);
  const auto feet = extra.uniform({batch, layers}, 0.95, 1.3) * g.height_px;
  const auto raised = extra.uniform({batch, layers}, 0.3, 1.0);
  const bool floor = g.floor_plane.defined();
  if (floor) {
    inverse_depth = g.plane.select(2, 2).to(torch::kFloat32);  // at the line of sight; the slope is small
  }
  const double middle = std::sqrt(c.depth_near * c.depth_far), side = std::min(g.height_px, g.width_px);
  place.radius = (place.radius * middle * inverse_depth.clamp_min(0.1)).clamp_max(6 * side);
  if (floor) {
    // The floor is as deep as the layer where m_floor . x equals the layer's inverse depth.
    const auto m = g.floor_plane.to(torch::kFloat32);
    const auto y = (inverse_depth - m.select(1, 2).view({-1, 1})) / m.select(1, 1).view({-1, 1});
    const auto foot = y * g.focal_px.to(torch::kFloat32).view({-1, 1}) + g.center_y;
    place.center_y = torch::where(upright, foot, foot - raised * place.radius);
  } else {
    place.center_y = torch::where(upright, feet, place.center_y);
  }
}

LayerPlacement draw_placement(const SceneConfig& c, const ShapeSet& shapes, std::int64_t batch, std::int64_t layers,
                              std::int64_t height, std::int64_t width, Random& random, const SceneGeometry* geometry,
                              Random& extra) {
  const double side = static_cast<double>(std::min(height, width));
  const double low = 0.5 - c.placement_spread, high = 0.5 + c.placement_spread;
  LayerPlacement place;
  place.center_x = random.uniform({batch, layers}, low, high) * static_cast<double>(width - 1);
  place.center_y = random.uniform({batch, layers}, low, high) * static_cast<double>(height - 1);
  place.radius = random.log_uniform({batch, layers}, c.min_size * side, c.max_size * side + 1e-9);
  if (geometry != nullptr) {
    place_in_depth(c, *geometry, shapes, place, extra);
  }
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

/// The row of each scene whose motion is to be taken out, -1 for none: int64 [B]. It is the one that most of the
/// picture shows: the nearest plate, else the background.
Tensor draw_still(const SceneConfig& c, const ShapeSet& shapes, const Tensor& present, Random& extra) {
  const std::int64_t batch = present.size(0), layers = present.size(1);
  const auto plate = shapes.unbounded().view({batch, layers}).logical_and(present > 0);
  const auto largest = torch::where(plate, torch::arange(layers).expand({batch, layers}), 0).amax(1);
  return torch::where(extra.chance({batch}, c.aligned_probability), largest, -1);
}

Appearance draw_appearance(const SceneConfig& c, const TextureBank& bank, std::int64_t batch, std::int64_t layers,
                           Random& random, Random& extra) {
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
  if (c.blink_probability > 0) {
    auto blinks = extra.chance({batch, layers, 1}, c.blink_probability);
    blinks.select(1, 0).fill_(false);
    const auto dim = torch::where(blinks, extra.uniform({batch, layers, 1}, 0.1, 0.6), torch::ones({batch, layers, 1}));
    const auto full = torch::ones_like(dim), second = extra.chance({batch, layers, 1}, 0.5);
    look.lit = torch::cat({torch::where(second, dim, full), torch::where(second, full, dim)}, 2);
  }
  return look;
}

}  // namespace

Scene Scene::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  const auto part = [&](const Tensor& x) { return x.defined() ? x.slice(0, begin, end).to(device) : x; };
  std::optional<SceneGeometry> where;
  if (geometry) {
    where = geometry->slice(begin, end, device);
  }
  return {end - begin,
          layers,
          height,
          width,
          {part(place.center_x), part(place.center_y), part(place.radius), part(place.extent)},
          part(present),
          shapes.slice(begin * layers, end * layers, device),
          motion.slice(begin * layers, end * layers, device),
          {part(look.index), part(look.affine), part(look.gain), part(look.bias), part(look.lit)},
          camera.slice(begin, end, device),
          lights.slice(begin, end, device),
          where};
}

Scene draw_scene(const SceneConfig& config, const TextureBank& bank, std::int64_t batch, std::int64_t height,
                 std::int64_t width, std::uint64_t seed) {
  // What came later is drawn from a stream of its own: scenes that do not use it stay as they were.
  Random random(seed), extra(seed ^ kExtraStream);
  const std::int64_t layers = layer_count(config);
  std::optional<SceneGeometry> geometry;
  if (config.camera != "off") {
    geometry = draw_geometry(config, batch, height, width, extra);
  }
  const SceneGeometry* in_depth = geometry ? &*geometry : nullptr;
  const ShapeSet shapes(config, batch * layers, random, &extra);
  const auto place = draw_placement(config, shapes, batch, layers, height, width, random, in_depth, extra);
  auto present = random.chance({batch, layers}, config.layer_probability).to(torch::kFloat32);
  auto motion = draw_motion(config, place, height, width, random, in_depth, &extra);
  if (config.aligned_probability > 0) {
    motion = motion.relative_to(draw_still(config, shapes, present, extra), layers);
  }
  const auto look = draw_appearance(config, bank, batch, layers, random, extra);
  const auto camera = draw_camera_effects(config, batch, random, &extra);
  const auto lights = draw_lights(config, batch, height, width, extra);
  return {batch, layers, height, width, place, present, shapes, motion, look, camera, lights, geometry};
}

}  // namespace ajna::synth
