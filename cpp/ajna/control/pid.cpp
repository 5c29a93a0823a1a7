// SPDX-License-Identifier: MIT
#include "ajna/control/pid.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna::control {

void validate(const PidOptions& options) {
  for (const double gain : {options.kp, options.ki, options.kd}) {
    if (!(std::isfinite(gain) && gain >= 0.0)) {
      throw_invalid("PID gain " + std::to_string(gain) + ": give finite gains of at least 0");
    }
  }
  if (!(options.derivative_cutoff_hz > 0.0 && options.max_dt_s > 0.0)) {
    throw_invalid("PID derivative_cutoff_hz and max_dt_s must be positive");
  }
  if (!(options.output_min < options.output_max)) {
    throw_invalid("PID output_min " + std::to_string(options.output_min) + " is not below output_max " +
                  std::to_string(options.output_max));
  }
}

Pid::Pid(const PidOptions& options) : options_(options) { validate(options); }

void Pid::reset() noexcept {
  integral_ = derivative_ = last_error_ = output_ = 0.0;
  started_ = false;
}

double Pid::update(double error, double dt_s) {
  if (!std::isfinite(error) || !std::isfinite(dt_s) || dt_s <= 0.0) {
    return output_;
  }
  if (dt_s > options_.max_dt_s) {
    reset();
  }
  double step = 0.0;
  if (started_) {
    const double tau_s = 1.0 / (2.0 * M_PI * options_.derivative_cutoff_hz);  // 0 for an infinite cut-off
    const double raw = (error - last_error_) / dt_s;
    derivative_ += dt_s / (tau_s + dt_s) * (raw - derivative_);
    step = options_.ki * error * dt_s;
  }
  const double free = options_.kp * error + integral_ + step + options_.kd * derivative_;
  const bool winds_up = (free > options_.output_max && step > 0.0) || (free < options_.output_min && step < 0.0);
  if (!winds_up) {
    integral_ += step;
  }
  output_ =
      std::clamp(options_.kp * error + integral_ + options_.kd * derivative_, options_.output_min, options_.output_max);
  last_error_ = error;
  started_ = true;
  return output_;
}

Eigen::Vector3d VectorPid::update(const Eigen::Vector3d& error, double dt_s) {
  return {axes_[0].update(error[0], dt_s), axes_[1].update(error[1], dt_s), axes_[2].update(error[2], dt_s)};
}

void VectorPid::reset() noexcept {
  for (Pid& axis : axes_) {
    axis.reset();
  }
}

}  // namespace ajna::control
