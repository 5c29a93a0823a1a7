// SPDX-License-Identifier: MIT
#include "ajna/tasks/occupancy.hpp"

#include <algorithm>
#include <cmath>

#include "ajna/base/range.hpp"

namespace ajna::tasks {
namespace {

int wrapped(int index, int side) { return ((index % side) + side) % side; }

}  // namespace

void validate(const OccupancyOptions& options) {
  require_between("navigate options: occupancy.cell_m", options.cell_m, 0.02, 2.0);
  require_between("navigate options: occupancy.seen", options.seen, 0.01, 100.0);
  require_between("navigate options: occupancy.passed", options.passed, 0.0, 100.0);
  require_between("navigate options: occupancy.sure_m", options.sure_m, 0.1, 1000.0);
  require_between("navigate options: occupancy.clear_share", options.clear_share, 0.0, 1.0);
  require_between("navigate options: occupancy.clear_near", options.clear_near, 0.0, 1.0);
  require_between("navigate options: occupancy.thickness", options.thickness, 0.0, 1.0);
  require_between("navigate options: occupancy.bound", options.bound, 0.1, 100.0);
  require_between("navigate options: occupancy.blocked", options.blocked, 0.0, options.bound);
  require_between("navigate options: occupancy.forget_m", options.forget_m, 0.1, 1000.0);
  require_between("navigate options: occupancy.max_range_m", options.max_range_m, 1.0, 30.0);
}

OccupancyMap::OccupancyMap(const OccupancyOptions& options) : options_(options) {
  validate(options);
  side_ = 2 * static_cast<int>(std::ceil(options.max_range_m * (1.0 + options.thickness) / options.cell_m)) + 4;
  cells_.resize(static_cast<std::size_t>(side_) * static_cast<std::size_t>(side_));
}

void OccupancyMap::reset() noexcept {
  std::fill(cells_.begin(), cells_.end(), Cell{});
  any_ = false;
}

int OccupancyMap::index_of(double metres) const { return static_cast<int>(std::floor(metres / options_.cell_m)); }

OccupancyMap::Cell& OccupancyMap::cell(int north, int east) {
  Cell& found = cells_[static_cast<std::size_t>(wrapped(north, side_)) * static_cast<std::size_t>(side_) +
                       static_cast<std::size_t>(wrapped(east, side_))];
  if (found.north != north || found.east != east) {
    found = Cell{north, east};
  }
  return found;
}

double OccupancyMap::evidence(const Eigen::Vector2d& point_m) const {
  const int north = index_of(point_m.x());
  const int east = index_of(point_m.y());
  const Cell& found = cells_[static_cast<std::size_t>(wrapped(north, side_)) * static_cast<std::size_t>(side_) +
                             static_cast<std::size_t>(wrapped(east, side_))];
  return found.north == north && found.east == east ? static_cast<double>(found.evidence) : 0.0;
}

void OccupancyMap::forget(const Eigen::Vector2d& position_m) {
  // In steps of a cell: the jitter of a hovering vehicle's position, added up, must not make it forget.
  const double moved_m = any_ ? (position_m - last_m_).norm() : 0.0;
  if (any_ && moved_m < options_.cell_m) {
    return;
  }
  const auto kept = static_cast<float>(std::exp(-moved_m / options_.forget_m));
  for (Cell& one : cells_) {
    one.evidence *= kept;
  }
  any_ = true;
  last_m_ = position_m;
}

void OccupancyMap::add(const HorizonScan& scan, const Eigen::Vector2d& position_m, double yaw_rad) {
  forget(position_m);
  const Eigen::Vector2d forward(std::cos(yaw_rad), std::sin(yaw_rad));
  const Eigen::Vector2d right(-forward.y(), forward.x());
  touched_.clear();
  const auto mark = [&](double distance_m, const Eigen::Vector2d& along, bool hit, double weight) {
    const Eigen::Vector2d at = position_m + distance_m * along;
    Cell& one = cell(index_of(at.x()), index_of(at.y()));
    if (one.hits == 0 && one.passes == 0) {
      touched_.push_back(static_cast<std::size_t>(&one - cells_.data()));
      one.weight = 0.0F;
    }
    ++(hit ? one.hits : one.passes);
    one.weight += static_cast<float>(hit ? weight * options_.seen : -options_.passed);
  };
  const double step = options_.cell_m / 2.0;
  const auto look = [&](const Eigen::Vector2d& point, bool thing, double clear_share) {
    const double distance = point.norm();
    if (!(distance > 0.0)) {
      return;
    }
    const Eigen::Vector2d along = (point.x() * forward + point.y() * right) / distance;
    const double passes = std::min(clear_share * distance, options_.max_range_m);
    for (double at = step; at < passes; at += step) {
      mark(at, along, false, 1.0);
    }
    if (thing && distance <= options_.max_range_m) {
      const double weight = std::min(1.0, options_.sure_m / distance);
      for (double at = distance; at <= distance * (1.0 + options_.thickness) + step; at += step) {
        mark(at, along, true, weight);
      }
    }
  };
  for (const auto& point : scan.things) {
    look(point, true, options_.clear_share);
  }
  for (const auto& point : scan.near) {
    look(point, true, options_.clear_near);
  }
  for (const auto& point : scan.free) {
    look(point, false, 1.0);
  }
  const auto bound = static_cast<float>(options_.bound);
  for (const std::size_t index : touched_) {
    Cell& one = cells_[index];
    // Of several rays through a cell the mean counts: they are no frames of their own.
    one.evidence = std::clamp(one.evidence + one.weight / static_cast<float>(one.hits + one.passes), -bound, bound);
    one.hits = one.passes = 0;
  }
}

Obstacles OccupancyMap::things(const Eigen::Vector2d& position_m, double yaw_rad) const {
  const Eigen::Vector2d forward(std::cos(yaw_rad), std::sin(yaw_rad));
  const Eigen::Vector2d right(-forward.y(), forward.x());
  Obstacles found;
  for (const Cell& one : cells_) {
    if (static_cast<double>(one.evidence) > options_.blocked) {
      const Eigen::Vector2d center((one.north + 0.5) * options_.cell_m, (one.east + 0.5) * options_.cell_m);
      const Eigen::Vector2d away = center - position_m;
      if (away.norm() <= options_.max_range_m) {
        found.emplace_back(away.dot(forward), away.dot(right));
      }
    }
  }
  return found;
}

}  // namespace ajna::tasks
