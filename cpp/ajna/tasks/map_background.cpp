// SPDX-License-Identifier: MIT
#include "ajna/tasks/map_background.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/tasks/map_histogram.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {
namespace {

/// Share of a running mean with time constant `tau_s` that a value after `dt_s` takes over.
double share(double dt_s, double tau_s) { return 1.0 - std::exp(-dt_s / tau_s); }

}  // namespace

void validate(const BackgroundOptions& options) {
  if (!(options.smooth_px > 0.0 && options.smooth_px <= 50.0) || options.border_px < 0 || options.border_px > 1000) {
    throw_invalid("background options: give smooth_px above 0 and up to 50, border_px from 0 to 1000");
  }
  if (!(options.learn_s > 0.0 && options.absorb_s >= options.learn_s && std::isfinite(options.absorb_s))) {
    throw_invalid("background options: give learn_s above 0, and absorb_s of at least that");
  }
  if (!(options.min_rise > 0.0 && options.noise_factor >= 1.0 && options.deviations >= 0.0)) {
    throw_invalid("background options: give min_rise above 0, noise_factor of at least 1, deviations of at least 0");
  }
  if (!(options.max_share > 0.0 && options.max_share <= 1.0 && options.max_turn_rad > 0.0)) {
    throw_invalid("background options: give max_share above 0 and up to 1, max_turn_rad above 0");
  }
}

MapBackground::MapBackground(const BackgroundOptions& options) : options_(options) { validate(options); }

void MapBackground::reset() noexcept { mean_.release(); }

std::optional<Rise> MapBackground::step(const cv::Mat& map, double time_s, double turned_rad) {
  cv::Mat smooth;
  cv::GaussianBlur(map, smooth, {}, options_.smooth_px, options_.smooth_px, cv::BORDER_REPLICATE);
  if (mean_.size() != smooth.size() || !(std::abs(turned_rad) <= options_.max_turn_rad)) {
    mean_ = smooth;
    deviation_ = cv::Mat::zeros(smooth.size(), CV_32F);
    begin_s_ = last_s_ = time_s;
    noise_ = 0.0;
    return std::nullopt;
  }
  const double interval_s = time_s - std::exchange(last_s_, time_s);
  const bool known = time_s - begin_s_ >= options_.learn_s;
  Rise rise;
  cv::Mat change = smooth - mean_;
  cv::max(change - options_.deviations * deviation_, 0.0, rise.map);
  const int b = std::min({options_.border_px, (map.rows - 1) / 2, (map.cols - 1) / 2});
  const cv::Rect inner(b, b, map.cols - 2 * b, map.rows - 2 * b);
  rise.threshold = std::max(options_.min_rise, options_.noise_factor * noise_);
  const cv::Mat above = rise.map > rise.threshold;
  const bool moved = cv::countNonZero(above(inner)) > options_.max_share * static_cast<double>(inner.area());
  cv::Mat quiet = change.clone();
  if (!moved) {
    quiet.setTo(0.0, above);  // what stands out is no noise
  }
  noise_ += share(interval_s, options_.learn_s) * (std::max(0.0, map_quantile(quiet(inner), 0.99)) - noise_);
  // While the mean is new, or the camera moves, all is learned alike; later what stands out is taken in slowly.
  const double all = share(interval_s, options_.learn_s);
  cv::Mat taken = change * (known && !moved ? all : std::max(all, interval_s / (time_s - begin_s_)));
  if (known && !moved) {
    cv::Mat(change * share(interval_s, options_.absorb_s)).copyTo(taken, above);
  }
  mean_ += taken;
  deviation_ += share(interval_s, options_.absorb_s) * (cv::abs(change) - deviation_);
  if (!known || moved) {
    return std::nullopt;
  }
  return rise;
}

}  // namespace ajna::tasks
