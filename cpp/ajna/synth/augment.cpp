// SPDX-License-Identifier: MIT
#include "ajna/synth/augment.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/synth/color.hpp"
#include "ajna/synth/photometric.hpp"
#include "ajna/synth/random.hpp"

namespace ajna::synth {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;

/// Neighbours whose flow differs by more than this lie on different surfaces: no interpolation between them.
constexpr double kSurfaceStep = 0.5;  // pixels

constexpr double kEdge = 1e-3;  // rounding that may not push a pixel out of the frame

struct Grid {
  Tensor x, y;  // [B, H, W], pixels
};

/// Affine maps [B, 2, 3] float64: x = a00 u + a01 v + a02, y = a10 u + a11 v + a12.
Grid apply(const Tensor& affine, const Tensor& u, const Tensor& v) {
  const auto a = [&](int row, int column) {
    return affine.select(1, row).select(1, column).to(u.device(), torch::kFloat32).view({-1, 1, 1});
  };
  return {a(0, 0) * u + a(0, 1) * v + a(0, 2), a(1, 0) * u + a(1, 1) * v + a(1, 2)};
}

Tensor compose(const Tensor& outer, const Tensor& inner) {
  const auto linear = outer.slice(2, 0, 2);
  auto result = linear.matmul(inner);
  result.select(2, 2).add_(outer.select(2, 2));
  return result;
}

Tensor inverted(const Tensor& affine) {
  const auto linear = torch::linalg_inv(affine.slice(2, 0, 2));
  return torch::cat({linear, -linear.matmul(affine.slice(2, 2, 3))}, 2);
}

/// Rotation by `angle`, then a scale per axis, about `center`, which goes to `target`; [B] float64 each -> [B, 2, 3].
Tensor affine_about(const Tensor& angle, const Tensor& scale_x, const Tensor& scale_y, const Tensor& center_x,
                    const Tensor& center_y, const Tensor& target_x, const Tensor& target_y) {
  const auto c = angle.cos(), s = angle.sin();
  const auto a00 = c * scale_x, a01 = -s * scale_y, a10 = s * scale_x, a11 = c * scale_y;
  const auto tx = target_x - a00 * center_x - a01 * center_y, ty = target_y - a10 * center_x - a11 * center_y;
  return torch::stack({a00, a01, tx, a10, a11, ty}, -1).view({-1, 2, 3});
}

/// Pixels of the augmented frames to pixels of the given ones.
struct Maps {
  Tensor first, second;
};

Maps draw_maps(const AugmentConfig& c, std::int64_t batch, std::int64_t from_height, std::int64_t from_width,
               std::int64_t height, std::int64_t width, Random& random) {
  const auto uniform = [&](double low, double high) { return random.uniform({batch}, low, high).to(torch::kFloat64); };
  const auto some = [&](double probability) { return random.chance({batch}, probability).to(torch::kFloat64); };
  const double w = static_cast<double>(width), h = static_cast<double>(height);
  const double from_w = static_cast<double>(from_width), from_h = static_cast<double>(from_height);

  const auto spatial = some(c.spatial_probability), stretched = spatial * some(c.stretch_probability);
  const auto scale = spatial * uniform(c.scale_min, c.scale_max);
  auto scale_x = (scale + stretched * uniform(-c.stretch, c.stretch)).exp2();
  auto scale_y = (scale + stretched * uniform(-c.stretch, c.stretch)).exp2();
  scale_x = scale_x.clamp_min(w / from_w);
  scale_y = scale_y.clamp_min(h / from_h);
  const auto angle = spatial * uniform(-c.rotation_deg, c.rotation_deg) * (kPi / 180.0);

  // The crop's centre, such that the crop without its rotation lies inside the frame.
  const auto slack_x = from_w - w / scale_x, slack_y = from_h - h / scale_y;
  auto left = slack_x * uniform(0, 1), top = slack_y * uniform(0, 1);
  const auto whole = spatial < 0.5;  // whole pixels where nothing is resampled
  left = torch::where(whole, left.round(), left);
  top = torch::where(whole, top.round(), top);
  const auto target_x = left + 0.5 * w / scale_x - 0.5, target_y = top + 0.5 * h / scale_y - 0.5;
  const auto center_x = torch::full_like(angle, 0.5 * (w - 1)), center_y = torch::full_like(angle, 0.5 * (h - 1));
  const auto flip_x = 1 - 2 * some(c.flip_x_probability), flip_y = 1 - 2 * some(c.flip_y_probability);

  Maps maps;
  maps.first = affine_about(angle, flip_x / scale_x, flip_y / scale_y, center_x, center_y, target_x, target_y);
  const auto relative = some(c.relative_probability);
  const auto shift_x = relative * uniform(-1, 1) * (c.relative_translation * w);
  const auto shift_y = relative * uniform(-1, 1) * (c.relative_translation * h);
  const auto turn = relative * uniform(-c.relative_rotation_deg, c.relative_rotation_deg) * (kPi / 180.0);
  const auto zoom = 1 + relative * uniform(-c.relative_scale, c.relative_scale);
  const auto motion = affine_about(turn, zoom, zoom, center_x, center_y, center_x + shift_x, center_y + shift_y);
  maps.second = compose(maps.first, motion);
  return maps;
}

Tensor sample(const Tensor& planes, const Grid& at, bool nearest) {
  const double height = static_cast<double>(planes.size(2)), width = static_cast<double>(planes.size(3));
  const auto grid = torch::stack({(2 * at.x + 1) / width - 1, (2 * at.y + 1) / height - 1}, -1);
  auto options = F::GridSampleFuncOptions().padding_mode(torch::kBorder).align_corners(false);
  return F::grid_sample(planes, grid, nearest ? options.mode(torch::kNearest) : options.mode(torch::kBilinear));
}

Tensor sample_mask(const Tensor& mask, const Grid& at) {
  return mask.defined() ? sample(mask.to(torch::kFloat32), at, true) > 0.5 : mask;
}

Tensor inside(const Grid& at, std::int64_t height, std::int64_t width) {
  const double low = -0.5 - kEdge, high = -0.5 + kEdge;
  return (at.x >= low)
      .logical_and(at.x <= static_cast<double>(width) + high)
      .logical_and(at.y >= low)
      .logical_and(at.y <= static_cast<double>(height) + high)
      .unsqueeze(1);
}

/// Flow and masks of one direction: `here` maps this frame's augmented pixels to given ones, `there` the other frame's.
struct Direction {
  Tensor flow, valid, occlusion, motion_boundary;
};

Direction transform(const Direction& given, const Tensor& here, const Tensor& there, std::int64_t height,
                    std::int64_t width) {
  const std::int64_t from_height = given.flow.size(2), from_width = given.flow.size(3);
  const auto options = given.flow.options();
  const auto u = torch::arange(width, options).view({1, 1, width}), v = torch::arange(height, options).view({1, -1, 1});
  const auto at = apply(here, u, v);
  const auto known = given.valid.logical_and(given.flow.isfinite().all(1, /*keepdim=*/true));
  const auto clean = torch::where(known, given.flow, torch::zeros_like(given.flow));
  const auto nearest = sample(clean, at, true), smooth = sample(clean, at, false);
  const auto surrounded = sample(known.to(torch::kFloat32), at, false) > 1 - 1e-4;
  const auto step = (smooth - nearest).square().sum(1, /*keepdim=*/true).sqrt();
  const auto flow = torch::where(surrounded.logical_and(step < kSurfaceStep), smooth, nearest);

  Direction result;
  result.valid = sample_mask(known, at).logical_and(inside(at, from_height, from_width));
  const Grid reached{at.x + flow.select(1, 0), at.y + flow.select(1, 1)};
  const auto target = apply(inverted(there), reached.x, reached.y);
  const auto moved = torch::stack({target.x - u, target.y - v}, 1);
  result.flow = torch::where(result.valid, moved, torch::zeros_like(moved));
  result.motion_boundary = sample_mask(given.motion_boundary, at);
  if (given.occlusion.defined()) {
    const auto seen = inside(target, height, width).logical_and(inside(reached, from_height, from_width));
    result.occlusion = sample_mask(given.occlusion, at).logical_or(seen.logical_not().logical_and(result.valid));
  }
  return result;
}

ColorChange draw_color(const AugmentConfig& c, std::int64_t batch, Random& random) {
  const auto around = [&](double strength) { return random.uniform({batch}, -strength, strength); };
  ColorChange change;
  change.brightness = around(c.brightness);
  change.contrast = 1 + around(c.contrast);
  change.hue = around(c.hue);
  change.saturation = 1 + around(c.saturation);
  change.gamma = 1 + around(c.gamma);
  return change;
}

/// Changes of the second frame: its own where `asymmetric`, else the first's.
ColorChange second_of(const ColorChange& first, const ColorChange& own, const Tensor& asymmetric) {
  const auto pick = [&](Tensor ColorChange::*m) { return torch::where(asymmetric, own.*m, first.*m); };
  return {pick(&ColorChange::brightness), pick(&ColorChange::contrast), pick(&ColorChange::hue),
          pick(&ColorChange::saturation), pick(&ColorChange::gamma)};
}

/// bool [B, 1, H, W]: pixels of frame 2 under a patch.
Tensor draw_patches(const AugmentConfig& c, std::int64_t batch, std::int64_t height, std::int64_t width,
                    const torch::Device& device, Random& random) {
  const double side = static_cast<double>(std::min(height, width));
  const auto present = random.chance({batch, 1}, c.patch_probability);
  const auto count = 1 + random.integers({batch, 1}, c.patch_count);
  const auto number = torch::arange(c.patch_count).view({1, -1});
  const auto used = present.logical_and(number < count);
  const auto left = random.uniform({batch, c.patch_count}, 0, static_cast<double>(width)).floor();
  const auto top = random.uniform({batch, c.patch_count}, 0, static_cast<double>(height)).floor();
  const auto size_x = random.uniform({batch, c.patch_count}, c.patch_min_size * side, c.patch_max_size * side).round();
  const auto size_y = random.uniform({batch, c.patch_count}, c.patch_min_size * side, c.patch_max_size * side).round();
  const auto each = [&](const Tensor& x) { return x.to(device).view({batch, c.patch_count, 1, 1}); };
  const auto u = torch::arange(width, device).view({1, 1, 1, width});
  const auto v = torch::arange(height, device).view({1, 1, height, 1});
  const auto across = (u >= each(left)).logical_and(u < each(left + size_x));
  const auto down = (v >= each(top)).logical_and(v < each(top + size_y));
  return across.logical_and(down).logical_and(each(used)).any(1, /*keepdim=*/true);
}

/// Is the target of each pixel under a patch of the other frame?
Tensor hits(const Tensor& patches, const Direction& way) {
  const auto u = torch::arange(way.flow.size(3), way.flow.options()).view({1, 1, -1});
  const auto v = torch::arange(way.flow.size(2), way.flow.options()).view({1, -1, 1});
  return sample_mask(patches, {u + way.flow.select(1, 0), v + way.flow.select(1, 1)}).logical_and(way.valid);
}

void check(const Tensor& x, const char* name, torch::ScalarType type, std::int64_t channels, const Tensor& frame1) {
  if (!x.defined()) {
    return;
  }
  if (x.dim() != 4 || x.scalar_type() != type || x.size(0) != frame1.size(0) || x.size(1) != channels ||
      x.size(2) != frame1.size(2) || x.size(3) != frame1.size(3) || x.device() != frame1.device()) {
    throw_invalid(std::string(name) + " is " + std::string(x.dtype().name()) + " " + c10::str(x.sizes()) + " on " +
                  c10::str(x.device()) + ": give " + c10::str(type) + " [B, " + std::to_string(channels) +
                  ", H, W] like frame1, which is " + c10::str(frame1.sizes()) + " on " + c10::str(frame1.device()));
  }
}

void check(const LabelledPairs& pairs, std::int64_t height, std::int64_t width, bool swaps) {
  const auto& first = pairs.frame1;
  if (!first.defined() || !pairs.frame2.defined() || !pairs.flow.defined()) {
    throw_invalid("a batch without frame1, frame2 or flow cannot be augmented: give all three");
  }
  if (first.dim() != 4 || first.numel() == 0) {
    throw_invalid("frame1 is " + c10::str(first.sizes()) + ": give uint8 [B, 3, H, W] with at least one pixel");
  }
  if (height < 1 || width < 1) {
    throw_invalid("crop of " + std::to_string(width) + "x" + std::to_string(height) + ": give at least 1x1 pixels");
  }
  check(pairs.frame1, "frame1", torch::kUInt8, 3, first);
  check(pairs.frame2, "frame2", torch::kUInt8, 3, first);
  check(pairs.flow, "flow", torch::kFloat32, 2, first);
  check(pairs.flow_backward, "flow_backward", torch::kFloat32, 2, first);
  check(pairs.valid, "valid", torch::kBool, 1, first);
  check(pairs.valid_backward, "valid_backward", torch::kBool, 1, first);
  check(pairs.occlusion, "occlusion", torch::kBool, 1, first);
  check(pairs.occlusion_backward, "occlusion_backward", torch::kBool, 1, first);
  check(pairs.motion_boundary, "motion_boundary", torch::kBool, 1, first);
  check(pairs.motion_boundary_backward, "motion_boundary_backward", torch::kBool, 1, first);
  if (!pairs.flow_backward.defined() && (pairs.valid_backward.defined() || pairs.occlusion_backward.defined() ||
                                         pairs.motion_boundary_backward.defined())) {
    throw_invalid("backward masks were given without flow_backward: give it, too, or leave them out");
  }
  const auto missing = [&](const Tensor& a, const Tensor& b) { return a.defined() != b.defined(); };
  if (swaps && (!pairs.flow_backward.defined() || missing(pairs.occlusion, pairs.occlusion_backward) ||
                missing(pairs.motion_boundary, pairs.motion_boundary_backward))) {
    throw_invalid(
        "frames cannot be swapped without flow_backward and the backward mask of each mask: give them, or set the "
        "augmentation option swap_probability to 0");
  }
}

void swap_where(const Tensor& swapped, Tensor& a, Tensor& b) {
  if (a.defined() && b.defined()) {
    const auto first = torch::where(swapped, b, a);
    b = torch::where(swapped, a, b);
    a = first;
  }
}

}  // namespace

Augmenter::Augmenter(const AugmentConfig& config) : config_(config) { validate(config_); }

LabelledPairs Augmenter::augment(const LabelledPairs& pairs, std::int64_t height, std::int64_t width,
                                 std::uint64_t seed) const {
  check(pairs, height, width, config_.swap_probability > 0);
  const torch::NoGradGuard no_grad;
  const auto device = pairs.frame1.device();
  const std::int64_t batch = pairs.frame1.size(0), from_height = pairs.frame1.size(2),
                     from_width = pairs.frame1.size(3);
  Random random(seed);

  LabelledPairs given = pairs;
  const bool backward = given.flow_backward.defined();
  const auto all = torch::ones({batch, 1, from_height, from_width}, given.flow.options().dtype(torch::kBool));
  given.valid = given.valid.defined() ? given.valid : all;
  given.valid_backward = given.valid_backward.defined() || !backward ? given.valid_backward : all;
  const auto swapped = random.chance({batch, 1, 1, 1}, config_.swap_probability).to(device);
  if (config_.swap_probability > 0) {
    swap_where(swapped, given.frame1, given.frame2);
    swap_where(swapped, given.flow, given.flow_backward);
    swap_where(swapped, given.valid, given.valid_backward);
    swap_where(swapped, given.occlusion, given.occlusion_backward);
    swap_where(swapped, given.motion_boundary, given.motion_boundary_backward);
  }

  const auto maps = draw_maps(config_, batch, from_height, from_width, height, width, random);
  auto forward = transform({given.flow, given.valid, given.occlusion, given.motion_boundary}, maps.first, maps.second,
                           height, width);
  Direction back;
  if (backward) {
    back =
        transform({given.flow_backward, given.valid_backward, given.occlusion_backward, given.motion_boundary_backward},
                  maps.second, maps.first, height, width);
  }
  const auto u = torch::arange(width, given.flow.options()).view({1, 1, width});
  const auto v = torch::arange(height, given.flow.options()).view({1, height, 1});
  auto image1 = sample(given.frame1.to(torch::kFloat32) / 255.0, apply(maps.first, u, v), false);
  auto image2 = sample(given.frame2.to(torch::kFloat32) / 255.0, apply(maps.second, u, v), false);

  const auto asymmetric = random.chance({batch}, config_.asymmetric_probability);
  const auto blurred = random.chance({batch}, config_.blur_probability).to(torch::kFloat32);
  const auto sigma1 = blurred * random.uniform({batch}, 0, config_.blur_max_px);
  const auto sigma2 = torch::where(asymmetric, blurred * random.uniform({batch}, 0, config_.blur_max_px), sigma1);
  image1 = defocus(image1, sigma1.to(device));
  image2 = defocus(image2, sigma2.to(device));

  const auto colored = random.chance({batch, 1, 1, 1}, config_.color_probability);
  const auto change1 = draw_color(config_, batch, random), own = draw_color(config_, batch, random);
  const auto change2 = second_of(change1, own, asymmetric);
  const auto deviation = random.uniform({batch, 1, 1, 1}, 0, config_.noise) * colored.to(torch::kFloat32);
  const auto on_device = [&](const ColorChange& c) {
    return ColorChange{c.brightness.to(device), c.contrast.to(device), c.hue.to(device), c.saturation.to(device),
                       c.gamma.to(device)};
  };
  if (config_.color_probability > 0) {
    const auto mean1 = image1.mean({2, 3}), mean2 = image2.mean({2, 3});
    const auto changes = colored.to(device);
    image1 = torch::where(changes, change_color(image1, 0.5 * (mean1 + mean2), on_device(change1)), image1);
    image2 = torch::where(changes, change_color(image2, 0.5 * (mean1 + mean2), on_device(change2)), image2);
  }
  if (config_.patch_probability > 0) {
    const auto patches = draw_patches(config_, batch, height, width, device, random);
    image2 = torch::where(patches, image2.mean({2, 3}, /*keepdim=*/true), image2);
    if (forward.occlusion.defined()) {
      forward.occlusion = forward.occlusion.logical_or(hits(patches, forward));
    }
    if (back.occlusion.defined()) {
      back.occlusion = back.occlusion.logical_or(patches);  // what the patch shows is not in frame 1
    }
  }
  if (config_.color_probability > 0 && config_.noise > 0) {
    const auto noise = device_normal({batch, 2, 3, height, width}, seed ^ 0x9E3779B97F4A7C15ULL, device);
    image1 = image1 + deviation.to(device) * noise.select(1, 0);
    image2 = image2 + deviation.to(device) * noise.select(1, 1);
  }

  const auto picture = [](const Tensor& x) { return (x * 255.0).round().clamp(0, 255).to(torch::kUInt8); };
  LabelledPairs result;
  result.frame1 = picture(image1);
  result.frame2 = picture(image2);
  result.flow = forward.flow;
  result.valid = forward.valid;
  result.occlusion = forward.occlusion;
  result.motion_boundary = forward.motion_boundary;
  result.flow_backward = back.flow;
  result.valid_backward = back.valid;
  result.occlusion_backward = back.occlusion;
  result.motion_boundary_backward = back.motion_boundary;
  return result;
}

}  // namespace ajna::synth
