// SPDX-License-Identifier: MIT
#include "ajna/nn/calibration.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::nn {
namespace {

using torch::Tensor;

// Scores from 1e-4 to 1e8 in bins of equal ratio; what is below falls into the first, what is above into the last,
// whose upper edge is infinite.
constexpr double kLowestScore = 1e-4;
constexpr double kBinWidth = 0.005;  // of log(score)
constexpr std::int64_t kBins = 5528;
// Sums of rounded shares may miss the exact rank by this much.
constexpr double kRounding = 1e-9;

torch::TensorOptions float64() { return torch::TensorOptions().dtype(torch::kFloat64); }

void check_image(const Tensor& first, const std::string& name, const Tensor& error, const Tensor& valid) {
  if (first.dim() != 3 || first.size(0) != 2 || error.sizes() != first.sizes()) {
    throw_invalid(name + " " + c10::str(first.sizes()) + " and error " + c10::str(error.sizes()) +
                  ": give both as [2, H, W]");
  }
  if (valid.scalar_type() != torch::kBool || valid.sizes() != first.sizes().slice(1)) {
    throw_invalid("valid is " + c10::str(valid.sizes(), " ", c10::toString(valid.scalar_type())) +
                  ": give bool [H, W] of the image's size");
  }
}

/// The valid pixels of [2, H, W] as float64 [2, M] on the CPU.
Tensor select(const Tensor& values, const Tensor& valid, const std::string& name) {
  auto chosen = values.index({torch::indexing::Slice(), valid}).to(torch::kCPU, torch::kFloat64);
  if (!chosen.isfinite().all().item<bool>()) {
    throw_invalid(name + " holds NaN or infinite values in valid pixels: mark these pixels as not valid");
  }
  return chosen;
}

/// Neighbouring knots as one sample: summed weight, mean error and mean position.
struct Group {
  double weight = 0.0, error = 0.0, position = 0.0;  // sums over the knots until finish()
  std::int64_t count = 1;                            // of the groups that were pooled into this one
  void finish() {
    error /= weight;
    position /= weight;
  }
};

std::vector<Group> group_knots(const Tensor& weight, const Tensor& error, double min_share) {
  const auto w = weight.accessor<double, 1>(), e = error.accessor<double, 1>();
  const double least = min_share * weight.sum().item<double>();
  std::vector<Group> groups(1);
  for (std::int64_t k = 0; k < w.size(0); ++k) {
    if (groups.back().weight > 0 && groups.back().weight >= least && w[k] > 0) {
      groups.emplace_back();
    }
    groups.back().weight += w[k];
    groups.back().error += e[k];
    groups.back().position += w[k] * static_cast<double>(k);
  }
  // What is left over at the end is too little to stand alone.
  if (groups.size() > 1 && groups.back().weight < least) {
    const Group rest = groups.back();
    groups.pop_back();
    groups.back().weight += rest.weight;
    groups.back().error += rest.error;
    groups.back().position += rest.position;
  }
  std::for_each(groups.begin(), groups.end(), [](Group& group) { group.finish(); });
  return groups;
}

/// Pool adjacent violators, in place: neighbours that do not rise become one block.
std::vector<Group> pool(const std::vector<Group>& groups, bool pool_equal) {
  std::vector<Group> blocks;
  for (Group block : groups) {
    while (!blocks.empty() &&
           (blocks.back().error > block.error || (pool_equal && blocks.back().error == block.error))) {
      const Group& before = blocks.back();
      const double weight = before.weight + block.weight;
      block.error = (before.weight * before.error + block.weight * block.error) / weight;
      block.position = (before.weight * before.position + block.weight * block.position) / weight;
      block.weight = weight;
      block.count += before.count;
      blocks.pop_back();
    }
    blocks.push_back(block);
  }
  return blocks;
}

/// The curve at `knots` positions through the blocks' centres; see ExpectedErrorFit.
std::vector<double> curve_through(const std::vector<Group>& blocks, const Tensor& old_curve) {
  const auto old_values = old_curve.to(torch::kFloat64).contiguous();
  const auto old_value = old_values.accessor<double, 1>();
  const Group& last = blocks.back();
  const auto last_knot = static_cast<std::int64_t>(std::floor(last.position));
  const std::int64_t next_knot = std::min(last_knot + 1, old_value.size(0) - 1);
  const double old_at_last = old_value[last_knot] + (last.position - static_cast<double>(last_knot)) *
                                                        (old_value[next_knot] - old_value[last_knot]);
  std::vector<double> curve;
  curve.reserve(static_cast<std::size_t>(old_value.size(0)));
  std::size_t above = 0;
  for (std::int64_t k = 0; k < old_value.size(0); ++k) {
    const auto position = static_cast<double>(k);
    while (above < blocks.size() && blocks[above].position <= position) {
      ++above;
    }
    if (above == 0) {
      curve.push_back(blocks.front().error);
    } else if (above == blocks.size()) {
      curve.push_back(old_at_last > 0 ? last.error * (old_value[k] / old_at_last) : last.error);
    } else {
      const Group &low = blocks[above - 1], &high = blocks[above];
      curve.push_back(low.error +
                      (high.error - low.error) * (position - low.position) / (high.position - low.position));
    }
  }
  return curve;
}

}  // namespace

void Calibration::check() const {
  factors.check();
  for (const char* key : {"data", "images", "pixels", "date"}) {
    const auto found = provenance.find(key);
    if (found == provenance.end() || found->second.empty()) {
      throw_invalid("calibration does not say its '" + std::string(key) +
                    "': give data, images, pixels and date in its provenance");
    }
  }
}

PixelWeighting parse_pixel_weighting(const std::string& name) {
  if (name == "image") return PixelWeighting::kImage;
  if (name == "pixel") return PixelWeighting::kPixel;
  throw_unknown("pixel weighting", name, {"image", "pixel"});
}

Tensor isotonic_regression(const Tensor& values, const Tensor& weights) {
  if (values.dim() != 1 || values.sizes() != weights.sizes()) {
    throw_invalid("values " + c10::str(values.sizes()) + " and weights " + c10::str(weights.sizes()) +
                  ": give two vectors of one length");
  }
  const auto y = values.detach().to(torch::kCPU, torch::kFloat64).contiguous();
  const auto w = weights.detach().to(torch::kCPU, torch::kFloat64).contiguous();
  if (!y.isfinite().all().item<bool>() || !w.isfinite().all().item<bool>() || !(w > 0).all().item<bool>()) {
    throw_invalid("isotonic regression needs finite values and finite weights above 0");
  }
  const auto value = y.accessor<double, 1>(), weight = w.accessor<double, 1>();
  std::vector<Group> groups;
  groups.reserve(static_cast<std::size_t>(y.size(0)));
  for (std::int64_t i = 0; i < y.size(0); ++i) {
    groups.push_back({weight[i], value[i], static_cast<double>(i)});
  }
  auto fitted = torch::empty_like(y);
  std::int64_t begin = 0;
  for (const Group& block : pool(groups, /*pool_equal=*/false)) {
    fitted.slice(0, begin, begin + block.count).fill_(block.error);
    begin += block.count;
  }
  return fitted;
}

ExpectedErrorFit::ExpectedErrorFit(UncertaintyTable table, double flow_scale, PixelWeighting weighting,
                                   double min_share)
    : table_(std::move(table)), flow_scale_(flow_scale), weighting_(weighting), min_share_(min_share) {
  table_.check();
  if (!std::isfinite(flow_scale) || flow_scale <= 0) {
    throw_invalid("flow_scale is " + c10::str(flow_scale) + ": give a finite number above 0");
  }
  if (!(min_share >= 0 && min_share <= 1)) {
    throw_invalid("min_share is " + c10::str(min_share) + ": give a share from 0 to 1");
  }
  table_ = table_.to(torch::kCPU);
  weight_ = torch::zeros({table_.expected_error.size(0)}, float64());
  error_ = torch::zeros_like(weight_);
}

void ExpectedErrorFit::add(const Tensor& raw, const Tensor& error, const Tensor& valid) {
  const torch::NoGradGuard no_grad;
  check_image(raw, "raw", error, valid);
  const auto chosen = select(raw, valid, "raw").flatten();
  const auto distance = select(error, valid, "error").abs().flatten();
  if (chosen.numel() == 0) {
    return;
  }
  const std::int64_t knots = weight_.size(0);
  const auto knot = chosen.sub(table_.raw_min)
                        .div(table_.raw_step)
                        .round()
                        .clamp(0.0, static_cast<double>(knots - 1))
                        .to(torch::kInt64);
  const double share = weighting_ == PixelWeighting::kImage ? 1.0 / static_cast<double>(chosen.numel()) : 0.5;
  weight_ += share * torch::bincount(knot, {}, knots).to(torch::kFloat64);
  error_ += share * torch::bincount(knot, distance, knots);
  ++images_;
  pixels_ += chosen.numel() / 2;
}

UncertaintyTable ExpectedErrorFit::table() const {
  if (images_ == 0) {
    throw_invalid("expected errors cannot be fitted without images: add images that have valid ground truth");
  }
  const auto blocks = pool(group_knots(weight_, error_, min_share_), /*pool_equal=*/true);
  auto curve = torch::tensor(curve_through(blocks, table_.expected_error), float64()).div(flow_scale_);
  UncertaintyTable result = table_;
  // Rounding to float32 keeps the order; the old curve may step back by rounding, the new one does not.
  result.expected_error = std::get<0>(curve.to(torch::kFloat32).cummax(0));
  // An expected error of exactly 0 would make every interval empty.
  result.expected_error.clamp_min_(1e-6);
  result.check();
  return result;
}

ConformalFit::ConformalFit(PixelWeighting weighting)
    : weighting_(weighting), weight_(torch::zeros({2, kBins}, float64())) {}

void ConformalFit::add(const Tensor& expected_error, const Tensor& error, const Tensor& valid) {
  const torch::NoGradGuard no_grad;
  check_image(expected_error, "expected error", error, valid);
  const auto scale = select(expected_error, valid, "expected error");
  const auto distance = select(error, valid, "error").abs();
  const std::int64_t count = scale.size(1);
  if (count == 0) {
    return;
  }
  // No error where none is expected scores 0, any other error there is infinitely off.
  const auto score = distance.div(scale).nan_to_num(0.0, INFINITY, INFINITY);
  const auto bin =
      score.div(kLowestScore).log().div(kBinWidth).ceil().clamp(0.0, static_cast<double>(kBins - 1)).to(torch::kInt64);
  const double share = weighting_ == PixelWeighting::kImage ? 1.0 / static_cast<double>(count) : 1.0;
  for (std::int64_t axis = 0; axis < 2; ++axis) {
    weight_[axis] += share * torch::bincount(bin[axis], {}, kBins).to(torch::kFloat64);
  }
  ++images_;
  pixels_ += count;
}

std::int64_t ConformalFit::units() const { return weighting_ == PixelWeighting::kImage ? images_ : pixels_; }

bool ConformalFit::reaches(double p) const {
  const auto n = static_cast<double>(units());
  return (n + 1) * p <= n * (1 + kRounding);
}

ConformalFactors ConformalFit::factors(const std::vector<double>& levels) const {
  ConformalFactors result;
  const auto n = static_cast<double>(units());
  const auto counted = weight_.cumsum(1);
  for (const double p : levels) {
    if (!(p > 0 && p < 1)) {
      throw_invalid("interval level " + c10::str(p) + " is not inside (0, 1): give for example 0.9");
    }
    const auto needed = static_cast<std::int64_t>(std::ceil(p / (1 - p) * (1 - kRounding)));
    const std::string what = weighting_ == PixelWeighting::kImage ? " images" : " pixels";
    if (!reaches(p)) {
      throw_invalid("interval level " + c10::str(p) + " needs at least " + std::to_string(needed) + what +
                    ", there are " + std::to_string(units()) + ": give more, or leave the level out");
    }
    const double rank = weighting_ == PixelWeighting::kImage ? (n + 1) * p : std::ceil((n + 1) * p * (1 - kRounding));
    std::array<double, 2> pair{};
    for (std::int64_t axis = 0; axis < 2; ++axis) {
      const double wanted = std::min(rank, n) * (1 - kRounding);
      const auto bin = torch::searchsorted(counted[axis], torch::tensor(wanted, float64())).item<std::int64_t>();
      if (bin >= kBins - 1) {
        throw_invalid("interval level " + c10::str(p) +
                      " would be infinite, as too many errors lie where no error is expected: leave the level out");
      }
      pair[static_cast<std::size_t>(axis)] = kLowestScore * std::exp(static_cast<double>(bin) * kBinWidth);
    }
    result.levels.push_back(p);
    result.factors.push_back(pair);
  }
  result.check();
  return result;
}

}  // namespace ajna::nn
