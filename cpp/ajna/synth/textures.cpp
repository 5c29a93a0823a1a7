// SPDX-License-Identifier: MIT
#include "ajna/synth/textures.hpp"

#include <cmath>
#include <vector>

#include "ajna/base/error.hpp"

namespace ajna::synth {
namespace {

namespace F = torch::nn::functional;
using torch::Tensor;
using torch::indexing::Slice;

Tensor coordinates(std::int64_t size) { return torch::arange(size, torch::kFloat32); }

/// Rotated coordinate in pixels: x cos(angle) + y sin(angle), [size, size].
Tensor rotated(std::int64_t size, double angle) {
  const auto axis = coordinates(size);
  return axis.unsqueeze(0) * std::cos(angle) + axis.unsqueeze(1) * std::sin(angle);
}

/// Multi-octave value noise, `channels` x size x size, about zero mean and unit range.
Tensor octave_noise(std::int64_t channels, std::int64_t size, Random& random) {
  const double persistence = random.number(0.4, 0.95);
  const std::int64_t first = 2 + random.integer(4);
  auto sum = torch::zeros({channels, size, size});
  double amplitude = 1.0;
  for (std::int64_t cells = first; cells <= size; cells *= 2) {
    const auto grid = random.normal({1, channels, cells, cells});
    sum += amplitude * torch::upsample_bicubic2d(grid, {size, size}, /*align_corners=*/false)[0];
    amplitude *= persistence;
  }
  return sum / sum.std().clamp_min(1e-6);
}

/// Map a scalar field (about unit deviation) to colour between random colours.
Tensor colorize(const Tensor& field, Random& random) {
  const auto low = random.uniform({3, 1, 1}), high = random.uniform({3, 1, 1});
  return low + (high - low) * torch::sigmoid(field * random.number(0.8, 3.0));
}

Tensor noise_texture(std::int64_t size, Random& random) {
  if (random.number() < 0.5) {
    return colorize(octave_noise(1, size, random), random);
  }
  return torch::sigmoid(octave_noise(3, size, random) * random.number(0.5, 1.5) + random.normal({3, 1, 1}, 0.7));
}

/// Discs, boxes and ellipses dropped on each other with power-law radii.
Tensor dead_leaves(std::int64_t size, Random& random) {
  auto picture = random.uniform({3, 1, 1}).expand({3, size, size}).clone();
  const std::int64_t leaves = 60 + random.integer(140);
  const double smallest = 2.0, largest = static_cast<double>(size) / 4;
  const bool boxes = random.number() < 0.4;
  const auto palette = random.uniform({8, 3});
  const auto axis = coordinates(size);
  for (std::int64_t i = 0; i < leaves; ++i) {
    // Radius density r^-2 between the bounds: many small leaves, few large ones.
    const double t = random.number();
    const double radius = 1.0 / ((1.0 - t) / largest + t / smallest);
    const double cx = random.number(0, static_cast<double>(size)), cy = random.number(0, static_cast<double>(size));
    const auto x0 = std::max<std::int64_t>(0, static_cast<std::int64_t>(cx - radius));
    const auto x1 = std::min<std::int64_t>(size, static_cast<std::int64_t>(cx + radius) + 2);
    const auto y0 = std::max<std::int64_t>(0, static_cast<std::int64_t>(cy - radius));
    const auto y1 = std::min<std::int64_t>(size, static_cast<std::int64_t>(cy + radius) + 2);
    const auto dx = (axis.slice(0, x0, x1) - cx).unsqueeze(0), dy = (axis.slice(0, y0, y1) - cy).unsqueeze(1);
    const auto distance = boxes ? torch::maximum(dx.abs(), dy.abs() * random.number(1.0, 2.0))
                                : (dx.square() + dy.square() * random.number(1.0, 3.0)).sqrt();
    const auto alpha = (radius - distance).clamp(0, 1).unsqueeze(0);
    const auto color = (palette[random.integer(8)] + random.normal({3}, 0.05)).view({3, 1, 1});
    auto region = picture.index({Slice(), Slice(y0, y1), Slice(x0, x1)});
    region.copy_(region * (1 - alpha) + color * alpha);
  }
  return picture + octave_noise(1, size, random) * random.number(0.0, 0.06);
}

Tensor stripes(std::int64_t size, Random& random) {
  const double period = std::exp(random.number(std::log(4.0), std::log(64.0)));
  auto wave = torch::sin(rotated(size, random.number(0, kPi)) * (2 * kPi / period)).unsqueeze(0);
  if (random.number() < 0.5) {
    wave = (wave * 8).clamp(-1, 1);
  }
  return colorize(wave * 1.5, random) + octave_noise(1, size, random) * random.number(0.0, 0.08);
}

Tensor checks(std::int64_t size, Random& random) {
  const double period = std::exp(random.number(std::log(6.0), std::log(64.0))), angle = random.number(0, kPi);
  const auto a = torch::sin(rotated(size, angle) * (2 * kPi / period));
  const auto b = torch::sin(rotated(size, angle + kPi / 2) * (2 * kPi / period / random.number(0.7, 1.4)));
  const auto field = ((a * b) * 12).clamp(-1, 1).unsqueeze(0);
  return colorize(field * 1.5, random) + octave_noise(1, size, random) * random.number(0.0, 0.08);
}

Tensor gradient(std::int64_t size, Random& random) {
  const auto ramp = rotated(size, random.number(0, 2 * kPi)).unsqueeze(0);
  const auto spread = (ramp - ramp.mean()) / (static_cast<double>(size) * random.number(0.2, 1.0));
  return colorize(spread * 2, random) + octave_noise(1, size, random) * random.number(0.0, 0.03);
}

/// Nearly uniform areas with a few straight borders: walls, sky, table tops.
Tensor flat_patches(std::int64_t size, Random& random) {
  auto picture = random.uniform({3, 1, 1}).expand({3, size, size}).clone();
  const std::int64_t patches = random.integer(6);
  for (std::int64_t i = 0; i < patches; ++i) {
    const auto ramp = rotated(size, random.number(0, 2 * kPi));
    const double offset = random.number(-0.4, 1.2) * static_cast<double>(size);
    const auto alpha = (ramp - offset).clamp(0, 1).unsqueeze(0);
    picture = picture * (1 - alpha) + random.uniform({3, 1, 1}) * alpha;
  }
  return picture + octave_noise(1, size, random) * random.number(0.0, 0.02);
}

Tensor make_texture_of(const TextureMix& mix, std::int64_t size, Random& random) {
  if (mix.flat <= 0 && mix.repetitive <= 0) {
    return make_texture(size, random);
  }
  const double share = random.number();
  if (share < mix.flat) {
    return (random.number() < 0.5 ? flat_patches(size, random) : gradient(size, random)).clamp(0, 1);
  }
  if (share < mix.flat + mix.repetitive) {
    return (random.number() < 0.5 ? stripes(size, random) : checks(size, random)).clamp(0, 1);
  }
  return make_texture(size, random);
}

/// Continue a coordinate by mirroring at the borders of [0, size - 1].
Tensor mirrored(const Tensor& x, std::int64_t size) {
  const double span = static_cast<double>(size - 1);
  const auto folded = (x - 2 * span * torch::floor(x / (2 * span)));
  return span - (folded - span).abs();
}

}  // namespace

Tensor make_texture(std::int64_t size, Random& random) {
  const double kind = random.number();
  Tensor picture;
  if (kind < 0.35) {
    picture = noise_texture(size, random);
  } else if (kind < 0.65) {
    picture = dead_leaves(size, random);
  } else if (kind < 0.75) {
    picture = stripes(size, random);
  } else if (kind < 0.84) {
    picture = checks(size, random);
  } else if (kind < 0.92) {
    picture = gradient(size, random);
  } else {
    picture = flat_patches(size, random);
  }
  return picture.clamp(0, 1);
}

TextureBank::TextureBank(std::int64_t count, std::int64_t size, std::uint64_t seed, const torch::Device& device,
                         const std::optional<Tensor>& photos, const TextureMix& mix)
    : procedural_(count), size_(size) {
  const torch::NoGradGuard no_grad;
  if (photos) {
    if (photos->dim() != 4 || photos->scalar_type() != torch::kUInt8 || photos->size(1) != 3 ||
        photos->size(2) != size || photos->size(3) != size) {
      throw_invalid("photographs of shape " + c10::str(photos->sizes()) + " and type " +
                    std::string(photos->dtype().name()) + ": give uint8 [N, 3, " + std::to_string(size) + ", " +
                    std::to_string(size) + "]");
    }
    photos_ = photos->size(0);
  }
  bank_ = torch::empty({1, 3, (procedural_ + photos_) * size, size});
  Random random(seed);
  for (std::int64_t i = 0; i < procedural_; ++i) {
    bank_[0].slice(1, i * size, (i + 1) * size).copy_(make_texture_of(mix, size, random));
  }
  for (std::int64_t i = 0; i < photos_; ++i) {
    const std::int64_t row = (procedural_ + i) * size;
    bank_[0].slice(1, row, row + size).copy_((*photos)[i].to(torch::kFloat32) / 255.0);
  }
  bank_ = bank_.to(device);
}

Tensor TextureBank::textures() const {
  return bank_[0].view({3, procedural_ + photos_, size_, size_}).transpose(0, 1).contiguous();
}

Tensor TextureBank::sample(const Tensor& index, const Tensor& u, const Tensor& v) const {
  const std::int64_t batch = u.size(0), layers = u.size(1), height = u.size(2), width = u.size(3);
  const double rows = static_cast<double>((procedural_ + photos_) * size_);
  const auto offset = (index.to(torch::kFloat32) * static_cast<double>(size_)).view({batch, layers, 1, 1});
  const auto x = mirrored(u, size_) * (2.0 / static_cast<double>(size_ - 1)) - 1.0;
  const auto y = (mirrored(v, size_) + offset) * (2.0 / (rows - 1.0)) - 1.0;
  const auto grid = torch::stack({x, y}, -1).view({batch, layers * height, width, 2});
  const auto picture = bank_.expand({batch, -1, -1, -1});
  const auto colors = F::grid_sample(
      picture, grid,
      F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kBorder).align_corners(true));
  return colors.view({batch, 3, layers, height, width}).transpose(1, 2);
}

}  // namespace ajna::synth
