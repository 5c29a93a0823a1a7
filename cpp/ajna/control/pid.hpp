// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <array>
#include <limits>

namespace ajna::control {

struct PidOptions {
  double kp = 1.0;
  double ki = 0.0;                     ///< 1 / s
  double kd = 0.0;                     ///< s
  double derivative_cutoff_hz = 10.0;  ///< first-order low pass on the derivative; infinite: none
  double output_min = -std::numeric_limits<double>::infinity();
  double output_max = std::numeric_limits<double>::infinity();
  double max_dt_s = 0.5;  ///< a longer gap restarts the controller: neither integral nor derivative spans it
};

/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const PidOptions& options);

/// A discrete PID controller (paper Eq. 5). The derivative is that of the error, through a low pass. Anti-windup by
/// conditional integration: while the output is at a limit, the integral only moves back from it.
class Pid {
 public:
  /// Throws as validate.
  explicit Pid(const PidOptions& options = {});

  /// One step; the output lies within the limits.
  /// The first step after construction, reset() or a gap above max_dt_s is proportional only (plus, after a gap,
  /// nothing of the past). dt_s <= 0 (a frame out of order, a repeated stamp) and values that are not finite change
  /// nothing: the last output is returned.
  double update(double error, double dt_s);
  /// Forget integral, derivative and output.
  void reset() noexcept;

  [[nodiscard]] double output() const noexcept { return output_; }
  [[nodiscard]] double integral() const noexcept { return integral_; }  ///< the integral term, ki included
  [[nodiscard]] const PidOptions& options() const noexcept { return options_; }

 private:
  PidOptions options_;
  double integral_ = 0.0;
  double derivative_ = 0.0;
  double last_error_ = 0.0;
  double output_ = 0.0;
  bool started_ = false;
};

/// Three controllers with equal options, one per component.
class VectorPid {
 public:
  explicit VectorPid(const PidOptions& options = {}) : axes_{Pid(options), Pid(options), Pid(options)} {}
  Eigen::Vector3d update(const Eigen::Vector3d& error, double dt_s);
  void reset() noexcept;

 private:
  std::array<Pid, 3> axes_;
};

}  // namespace ajna::control
