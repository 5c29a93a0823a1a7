// SPDX-License-Identifier: MIT
#include "ajna/synth/shapes.hpp"

#include <vector>

namespace ajna::synth {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

constexpr double kExtent = 1.3;       // half side of the raster, in layer radii
constexpr std::int64_t kRaster = 64;  // raster side; bilinear interpolation keeps straight edges straight
constexpr std::int64_t kSegments = 4;

struct RasterGrid {
  Tensor x, y;  // [1, Q, Q]
};

RasterGrid raster_grid() {
  const auto axis = torch::linspace(-kExtent, kExtent, kRaster);
  return {axis.view({1, 1, kRaster}).expand({1, kRaster, kRaster}),
          axis.view({1, kRaster, 1}).expand({1, kRaster, kRaster})};
}

/// Scale a field whose zero set is the outline so that it grows by about one per unit of distance near it.
Tensor normalize_gradient(const Tensor& field) {
  const double cell = 2 * kExtent / static_cast<double>(kRaster - 1);
  const auto padded = F::pad(field.unsqueeze(1), F::PadFuncOptions({1, 1, 1, 1}).mode(torch::kReplicate)).squeeze(1);
  const auto dx = (padded.slice(1, 1, -1).slice(2, 2) - padded.slice(1, 1, -1).slice(2, 0, -2)) / (2 * cell);
  const auto dy = (padded.slice(2, 1, -1).slice(1, 2) - padded.slice(2, 1, -1).slice(1, 0, -2)) / (2 * cell);
  return field / (dx.square() + dy.square()).sqrt().clamp_min(0.2);
}

/// Smooth star-shaped outlines r(angle) = aspect ellipse times a Fourier wobble.
Tensor blobs(std::int64_t rows, const RasterGrid& grid, Random& random) {
  const auto aspect = random.log_uniform({rows, 1, 1}, 0.35, 1.0);
  const auto turn = random.uniform({rows, 1, 1}, 0, 2 * kPi);
  const auto x = grid.x * turn.cos() + grid.y * turn.sin(), y = (grid.y * turn.cos() - grid.x * turn.sin()) / aspect;
  const auto angle = torch::atan2(y, x);
  auto outline = torch::ones_like(angle);
  // Half of them are plain ellipses.
  const auto wobble = random.chance({rows, 1, 1}, 0.5).to(torch::kFloat32) * random.uniform({rows, 1, 1}, 0.05, 0.3);
  for (const std::int64_t harmonic : {2, 3, 5, 7}) {
    const auto amplitude = wobble * random.normal({rows, 1, 1}) / (0.5 * static_cast<double>(harmonic));
    outline = outline +
              amplitude * torch::cos(angle * static_cast<double>(harmonic) + random.uniform({rows, 1, 1}, 0, 2 * kPi));
  }
  return normalize_gradient(outline.clamp(0.25, 1.2) - (x.square() + y.square()).sqrt());
}

/// Convex polygons as intersections of half planes; a third are boxes.
Tensor polygons(std::int64_t rows, const RasterGrid& grid, Random& random) {
  constexpr std::int64_t kSides = 8;
  const auto turn = random.uniform({rows, 1}, 0, 2 * kPi);
  const auto sides = 3 + random.integers({rows, 1}, kSides - 2);
  const auto box = random.chance({rows, 1}, 0.33);
  const auto number = torch::arange(kSides, torch::kFloat32).unsqueeze(0);
  const auto count = torch::where(box, torch::full_like(sides, 4), sides).to(torch::kFloat32);
  const auto jitter = random.normal({rows, kSides}, 0.15) * box.logical_not().to(torch::kFloat32);
  const auto angle = turn + (number.remainder(count) / count) * (2 * kPi) + jitter;
  const auto aspect = random.log_uniform({rows, 1}, 0.25, 1.0);
  const auto box_distance = torch::where(number.remainder(2.0) < 0.5, torch::ones({rows, kSides}), aspect) * 0.9;
  const auto free_distance = random.uniform({rows, kSides}, 0.4, 0.9);
  const auto distance = torch::where(box, box_distance, free_distance);
  auto inside = torch::full({rows, kRaster, kRaster}, 1e3);
  for (std::int64_t side = 0; side < kSides; ++side) {
    const auto a = angle.select(1, side).view({rows, 1, 1}), d = distance.select(1, side).view({rows, 1, 1});
    inside = torch::minimum(inside, d - (grid.x * a.cos() + grid.y * a.sin()));
  }
  return inside;
}

}  // namespace

ShapeSet::ShapeSet(const SceneConfig& config, std::int64_t rows, Random& random, Random* extra) {
  Random& more = extra != nullptr ? *extra : random;
  const auto grid = raster_grid();
  const double plates_to = config.blob_weight + config.polygon_weight + config.bar_weight + config.plate_weight;
  const double total = plates_to + config.trunk_weight;
  const auto pick = random.uniform({rows}, 0, total);
  const double polygon_from = config.blob_weight, bar_from = polygon_from + config.polygon_weight,
               plate_from = bar_from + config.bar_weight;
  const auto by_row = [&](const Tensor& condition) { return condition.view({rows, 1, 1}); };

  const auto blob = blobs(rows, grid, random), polygon = polygons(rows, grid, random);
  raster_ = torch::where(by_row(pick < polygon_from), blob, polygon);
  // A plate is everything but a hole; half of the plates end at a box around it.
  auto hole = torch::where(by_row(random.chance({rows}, 0.5)), blob, polygon) - random.uniform({rows, 1, 1}, 0, 0.3);
  if (config.hole_union_probability > 0) {
    const auto joined = torch::maximum(blob, polygon) - more.uniform({rows, 1, 1}, 0, 0.3);
    hole = torch::where(by_row(more.chance({rows}, config.hole_union_probability)), joined, hole);
  }
  const auto side = random.uniform({rows, 1, 1}, 1.05, 1.25);
  const auto frame = side - torch::maximum(grid.x.abs(), grid.y.abs());
  const auto plate =
      torch::where(by_row(random.chance({rows}, config.plate_frame_probability)), torch::minimum(frame, -hole), -hole);
  unbounded_ = pick >= plate_from;
  upright_ = torch::zeros({rows}, torch::kBool);
  if (config.trunk_weight > 0) {
    upright_ = pick >= plates_to;
    unbounded_ = unbounded_.logical_and(upright_.logical_not());
  }
  raster_ = torch::where(by_row(unbounded_), plate, raster_).contiguous();

  is_bar_ = (pick >= bar_from).logical_and(pick < plate_from);
  // A trunk through the middle and up to three twigs that start on it.
  const auto turn = random.uniform({rows}, 0, kPi);
  const auto trunk_x = turn.cos(), trunk_y = turn.sin();
  std::vector<Tensor> ends = {torch::stack({-trunk_x, -trunk_y, trunk_x, trunk_y}, -1)};
  std::vector<Tensor> radii = {random.log_uniform({rows}, 0.015, 0.12)};
  const auto twigs = random.integers({rows}, kSegments);
  for (std::int64_t i = 1; i < kSegments; ++i) {
    const auto start = random.uniform({rows}, -0.7, 0.7), angle = turn + random.normal({rows}, 0.9);
    const auto length = random.uniform({rows}, 0.2, 0.9);
    const auto x0 = start * trunk_x, y0 = start * trunk_y;
    ends.push_back(torch::stack({x0, y0, x0 + length * angle.cos(), y0 + length * angle.sin()}, -1));
    // An absent twig has a radius that no point can be inside of.
    radii.push_back(torch::where(twigs >= i, radii[0] * random.uniform({rows}, 0.4, 0.9), torch::full({rows}, -10.0)));
  }
  segments_ = torch::stack(ends, 1);
  radius_ = torch::stack(radii, 1);
  if (config.trunk_weight > 0) {
    plant_trees(more);
  }
}

/// Replace the bars of upright rows by trees: a trunk up from the origin that leans a little, and twigs on it.
void ShapeSet::plant_trees(Random& random) {
  const std::int64_t rows = upright_.size(0);
  const auto height = random.uniform({rows}, 3.0, 9.0), lean = random.normal({rows}, 0.04);
  const auto thickness = random.log_uniform({rows}, 0.06, 0.16), zero = torch::zeros({rows});
  std::vector<Tensor> ends = {torch::stack({zero, zero, lean * height, -height}, -1)};
  std::vector<Tensor> radii = {thickness};
  for (std::int64_t i = 1; i < kSegments; ++i) {
    const auto from = random.uniform({rows}, 0.8, 4.0), length = random.uniform({rows}, 0.4, 1.6);
    const auto rise = random.uniform({rows}, 0.2, 1.3);
    const auto side = torch::where(random.chance({rows}, 0.5), torch::ones({rows}), -torch::ones({rows}));
    const auto x0 = lean * from;
    ends.push_back(torch::stack({x0, -from, x0 + side * length * rise.cos(), -from - length * rise.sin()}, -1));
    radii.push_back(torch::where(from < height, thickness * random.uniform({rows}, 0.25, 0.6), zero - 10.0));
  }
  segments_ = torch::where(upright_.view({rows, 1, 1}), torch::stack(ends, 1), segments_);
  radius_ = torch::where(upright_.view({rows, 1}), torch::stack(radii, 1), radius_);
  is_bar_ = is_bar_.logical_or(upright_);
}

ShapeSet ShapeSet::slice(std::int64_t begin, std::int64_t end, const torch::Device& device) const {
  ShapeSet part;
  part.raster_ = raster_.slice(0, begin, end).to(device);
  part.unbounded_ = unbounded_.slice(0, begin, end).to(device);
  part.upright_ = upright_.slice(0, begin, end).to(device);
  part.is_bar_ = is_bar_.slice(0, begin, end).to(device);
  part.segments_ = segments_.slice(0, begin, end).to(device);
  part.radius_ = radius_.slice(0, begin, end).to(device);
  return part;
}

Tensor ShapeSet::signed_distance(const Tensor& x, const Tensor& y) const {
  const auto grid = torch::stack({x, y}, -1) / kExtent;
  auto distance =
      F::grid_sample(raster_.unsqueeze(1), grid,
                     F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kBorder).align_corners(true))
          .squeeze(1);
  const auto bars = is_bar_.nonzero().squeeze(1);
  if (bars.size(0) == 0) {
    return distance;
  }
  const auto bx = x.index_select(0, bars), by = y.index_select(0, bars);
  const auto segments = segments_.index_select(0, bars), radius = radius_.index_select(0, bars);
  const auto column = [&](std::int64_t s, std::int64_t k) {
    return segments.select(1, s).select(1, k).view({-1, 1, 1});
  };
  Tensor best;
  for (std::int64_t s = 0; s < kSegments; ++s) {
    const auto x0 = column(s, 0), y0 = column(s, 1), ux = column(s, 2) - x0, uy = column(s, 3) - y0;
    const auto px = bx - x0, py = by - y0;
    const auto along = ((px * ux + py * uy) / (ux.square() + uy.square())).clamp(0, 1);
    const auto apart = ((px - along * ux).square() + (py - along * uy).square()).sqrt();
    const auto inside = radius.select(1, s).view({-1, 1, 1}) - apart;
    best = best.defined() ? torch::maximum(best, inside) : inside;
  }
  return distance.index_copy(0, bars, best);
}

}  // namespace ajna::synth
