// SPDX-License-Identifier: MIT
#include "ajna/geometry/focus_of_expansion.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <random>
#include <string>

#include "ajna/base/error.hpp"

namespace ajna::geometry {
namespace {

using Eigen::Matrix2d;
using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Points = std::vector<Vector2d>;

/// Tukey's biweight with its end at three inlier distances: smooth, and 0 for what is surely wrong.
double tukey(double residual_px, double inlier_px) {
  const double t = residual_px / (3.0 * inlier_px);
  return t >= 1.0 ? 0.0 : (1.0 - t * t) * (1.0 - t * t);
}

void check_matches(const Points& begin, const Points& end) {
  if (begin.size() != end.size()) {
    throw_invalid(std::to_string(begin.size()) + " begin points and " + std::to_string(end.size()) +
                  " end points: give as many of each");
  }
  for (std::size_t i = 0; i < begin.size(); ++i) {
    if (!begin[i].allFinite() || !end[i].allFinite()) {
      throw_invalid("match " + std::to_string(i) + " is not finite: remove it");
    }
  }
}

bool enough(int inliers, std::size_t usable, const FitOptions& options) {
  return inliers >= options.min_inliers && inliers >= options.min_inlier_ratio * static_cast<double>(usable);
}

/// A line of motion through begin and end of a match.
struct Line {
  Vector2d normal;
  double offset;
  Vector2d begin;
  double length;  ///< of the motion
  std::size_t match;
  /// Pixels of measured motion per pixel of distance between p and the line: matches far away from p, or that hardly
  /// move, say less of it.
  [[nodiscard]] double leverage(const Vector2d& p) const { return length / std::max(1.0, (begin - p).norm()); }
  /// By how much the match would have to end elsewhere for its line to pass through p.
  [[nodiscard]] double residual(const Vector2d& p) const { return std::abs(normal.dot(p) - offset) * leverage(p); }
};

int count_inliers(const std::vector<Line>& lines, const Vector2d& p, double inlier_px) {
  return static_cast<int>(
      std::count_if(lines.begin(), lines.end(), [&](const Line& line) { return line.residual(p) <= inlier_px; }));
}

/// Residuals of (rate, shift) in pixels of the end point.
struct ExpansionModel {
  double rate = 0.0;
  Vector2d shift = Vector2d::Zero();
  [[nodiscard]] double residual(const Vector2d& begin, const Vector2d& end) const {
    return (end - (begin - shift) / (1.0 - rate)).norm();
  }
};

/// Weighted normal equations of end - begin = rate * end - shift, coordinates relative to `center` (conditioning).
Matrix3d expansion_normal(const Points& begin, const Points& end, const std::vector<double>& weight,
                          const Vector2d& center, Vector3d& right) {
  Matrix3d normal = Matrix3d::Zero();
  right.setZero();
  for (std::size_t i = 0; i < begin.size(); ++i) {
    if (weight[i] > 0.0) {
      const Vector2d e = end[i] - center;
      const Vector2d d = end[i] - begin[i];
      Eigen::Matrix<double, 2, 3> a;
      a << e.x(), -1.0, 0.0, e.y(), 0.0, -1.0;
      normal += weight[i] * a.transpose() * a;
      right += weight[i] * a.transpose() * d;
    }
  }
  return normal;
}

}  // namespace

const char* to_string(FitStatus status) noexcept {
  switch (status) {
    case FitStatus::kOk:
      return "ok";
    case FitStatus::kTooFewPoints:
      return "too_few_points";
    case FitStatus::kNoConsensus:
      return "no_consensus";
    case FitStatus::kIllConditioned:
      return "ill_conditioned";
  }
  return "unknown";
}

void validate(const FitOptions& options) {
  if (!(options.inlier_px > 0.0 && options.max_uncertainty_px > 0.0 && options.min_motion_px >= 0.0)) {
    throw_invalid("fit options: inlier_px and max_uncertainty_px must be positive and min_motion_px not negative");
  }
  if (options.min_inliers < 3 || options.trials < 1 || options.refinements < 1 ||
      !(options.min_inlier_ratio >= 0.0 && options.min_inlier_ratio <= 1.0)) {
    throw_invalid(
        "fit options: give min_inliers of at least 3, at least one trial and refinement and min_inlier_ratio from 0 to "
        "1");
  }
}

FocusOfExpansion focus_of_expansion(const Points& begin, const Points& end, const FitOptions& options) {
  validate(options);
  check_matches(begin, end);
  FocusOfExpansion result;
  result.is_inlier.assign(begin.size(), false);
  std::vector<Line> lines;
  for (std::size_t i = 0; i < begin.size(); ++i) {
    const Vector2d d = end[i] - begin[i];
    const double length = d.norm();
    if (length >= options.min_motion_px && length > 0.0) {
      const Vector2d normal = Vector2d(-d.y(), d.x()) / length;
      lines.push_back({normal, normal.dot(begin[i]), begin[i], length, i});
    }
  }
  if (static_cast<int>(lines.size()) < options.min_inliers) {
    return result;
  }

  std::mt19937 random(options.seed);
  std::uniform_int_distribution<std::size_t> pick(0, lines.size() - 1);
  Vector2d best = Vector2d::Zero();
  int best_count = 0;
  bool crossed = false;
  for (int trial = 0; trial < options.trials; ++trial) {
    const Line& a = lines[pick(random)];
    const Line& b = lines[pick(random)];
    const double determinant = a.normal.x() * b.normal.y() - a.normal.y() * b.normal.x();
    if (std::abs(determinant) < 1e-3) {
      continue;
    }
    crossed = true;
    const Vector2d p((a.offset * b.normal.y() - b.offset * a.normal.y()) / determinant,
                     (b.offset * a.normal.x() - a.offset * b.normal.x()) / determinant);
    const int count = count_inliers(lines, p, options.inlier_px);
    if (count > best_count) {
      best_count = count;
      best = p;
    }
  }
  if (!crossed) {
    result.status = FitStatus::kIllConditioned;
    return result;
  }

  Matrix2d normal = Matrix2d::Zero();
  for (int round = 0; round < options.refinements; ++round) {
    normal.setZero();
    Vector2d right = Vector2d::Zero();
    for (const Line& line : lines) {
      const double leverage = line.leverage(best);
      const double w = tukey(line.residual(best), options.inlier_px) * leverage * leverage;
      normal += w * line.normal * line.normal.transpose();
      right += w * line.offset * line.normal;
    }
    const Eigen::LDLT<Matrix2d> solver(normal);
    if (solver.info() != Eigen::Success || !(normal.determinant() > 1e-9 * normal.trace() * normal.trace())) {
      result.status = FitStatus::kIllConditioned;
      return result;
    }
    best = solver.solve(right);
  }

  double squares = 0.0;
  for (const Line& line : lines) {
    const double residual = line.residual(best);
    if (residual <= options.inlier_px) {
      result.is_inlier[line.match] = true;
      ++result.inliers;
      squares += residual * residual;
    }
  }
  if (!enough(result.inliers, lines.size(), options)) {
    result.status = FitStatus::kNoConsensus;
    return result;
  }
  result.point_px = best;
  result.covariance_px2 = squares / std::max(1, result.inliers - 2) * normal.inverse();
  const double sigma = std::sqrt(std::max(0.0, result.covariance_px2.eigenvalues().real().maxCoeff()));
  result.status = sigma <= options.max_uncertainty_px ? FitStatus::kOk : FitStatus::kIllConditioned;
  return result;
}

bool Expansion::has_focus() const { return status == FitStatus::kOk && std::abs(rate) > 3.0 * rate_sigma + 1e-9; }

Expansion fit_expansion(const Points& begin, const Points& end, const FitOptions& options) {
  validate(options);
  check_matches(begin, end);
  Expansion result;
  result.is_inlier.assign(begin.size(), false);
  if (static_cast<int>(begin.size()) < options.min_inliers) {
    return result;
  }

  std::mt19937 random(options.seed);
  std::uniform_int_distribution<std::size_t> pick(0, begin.size() - 1);
  ExpansionModel best;
  int best_count = -1;
  for (int trial = 0; trial < options.trials; ++trial) {
    const std::size_t i = pick(random);
    const std::size_t j = pick(random);
    const Vector2d base = end[j] - end[i];
    if (base.squaredNorm() < 4.0) {
      continue;
    }
    ExpansionModel model;
    model.rate = base.dot(base - (begin[j] - begin[i])) / base.squaredNorm();
    if (!(model.rate < 0.9)) {
      continue;
    }
    model.shift = model.rate * end[i] - (end[i] - begin[i]);
    int count = 0;
    for (std::size_t k = 0; k < begin.size(); ++k) {
      count += model.residual(begin[k], end[k]) <= options.inlier_px ? 1 : 0;
    }
    if (count > best_count) {
      best_count = count;
      best = model;
    }
  }
  if (best_count < 0) {
    result.status = FitStatus::kIllConditioned;  // all matches lie on one spot
    return result;
  }

  Vector2d center = Vector2d::Zero();
  for (const Vector2d& point : end) {
    center += point / static_cast<double>(end.size());
  }
  Matrix3d normal = Matrix3d::Zero();
  std::vector<double> weight(begin.size());
  for (int round = 0; round < options.refinements; ++round) {
    for (std::size_t i = 0; i < begin.size(); ++i) {
      weight[i] = tukey(best.residual(begin[i], end[i]), options.inlier_px);
    }
    Vector3d right;
    normal = expansion_normal(begin, end, weight, center, right);
    const Eigen::LDLT<Matrix3d> solver(normal);
    if (solver.info() != Eigen::Success || !(solver.vectorD().minCoeff() > 1e-9)) {
      result.status = FitStatus::kNoConsensus;
      return result;
    }
    const Vector3d solution = solver.solve(right);
    best.rate = std::min(solution.x(), 0.9);
    best.shift = solution.tail<2>() + solution.x() * center;
  }

  double squares = 0.0;
  for (std::size_t i = 0; i < begin.size(); ++i) {
    const double residual = best.residual(begin[i], end[i]);
    if (residual <= options.inlier_px) {
      result.is_inlier[i] = true;
      ++result.inliers;
      squares += residual * residual;
    }
  }
  if (!enough(result.inliers, begin.size(), options)) {
    result.status = FitStatus::kNoConsensus;
    return result;
  }
  result.rate = best.rate;
  result.shift_px = best.shift;
  result.rate_sigma = std::sqrt(squares / std::max(1, 2 * result.inliers - 3) * normal.inverse()(0, 0));
  result.status = FitStatus::kOk;
  return result;
}

}  // namespace ajna::geometry
