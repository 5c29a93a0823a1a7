// SPDX-License-Identifier: MIT
#include "ajna/tasks/navigate.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

#include "ajna/base/error.hpp"
#include "ajna/geometry/camera.hpp"
#include "ajna/geometry/motion_field.hpp"
#include "ajna/geometry/pose.hpp"
#include "ajna/tasks/map_histogram.hpp"

namespace ajna::tasks {
namespace {

/// The pixel of a direction, brought into the image; behind the camera it is the edge on that side.
Eigen::Vector2d pixel_of(const geometry::Camera& camera, const Eigen::Vector3d& body_direction) {
  Eigen::Vector3d ray = geometry::camera_from_body(body_direction).normalized();
  ray.z() = std::max(ray.z(), 1e-3);
  const Eigen::Vector2d pixel = camera.project(ray).value_or(Eigen::Vector2d(camera.cx, camera.cy));
  return {std::clamp(pixel.x(), 0.0, camera.width - 1.0), std::clamp(pixel.y(), 0.0, camera.height - 1.0)};
}

cv::Rect window_about(const Eigen::Vector2d& pixel, const cv::Size& size, const NavigateOptions& options) {
  const int width = std::max(1, cvRound(options.window_width * size.width));
  const int height = std::max(1, cvRound(options.window_height * size.height));
  // Moved, not cut: a goal at the edge must not leave a sliver to look at.
  const int x = std::clamp(cvRound(pixel.x()) - width / 2, 0, size.width - width);
  const int y = std::clamp(cvRound(pixel.y()) - height / 2, 0, size.height - height);
  return {x, y, width, height};
}

}  // namespace

const char* to_string(NavigateStatus status) noexcept {
  switch (status) {
    case NavigateStatus::kOk:
      return "ok";
    case NavigateStatus::kBlocked:
      return "blocked";
    case NavigateStatus::kOutOfOrder:
      return "out_of_order";
    case NavigateStatus::kInvalidInput:
      return "invalid_input";
  }
  return "unknown";
}

const char* to_string(WeightRule rule) noexcept {
  switch (rule) {
    case WeightRule::kLimits:
      return "limits";
    case WeightRule::kRescaled:
      return "rescaled";
    case WeightRule::kPrinted:
      return "printed";
  }
  return "unknown";
}

double navigation_weight(WeightRule rule, double y_close, double y_other, double y_free, double floor) {
  if (!(y_close >= 0.0 && y_other >= 0.0 && y_free >= 0.0 && floor > 0.0)) {
    throw_invalid("navigation weight: give uncertainties of at least 0 and a positive floor");
  }
  const double close = std::max(y_close, floor);
  const double other = std::clamp(y_other, floor, close);
  const double depth_ratio = close / other;  // Z_o / Z_close
  switch (rule) {
    case WeightRule::kLimits:
      return std::tanh(0.5 * std::max(0.0, 0.5 * (close + other) / std::max(y_free, floor) - 1.0));
    case WeightRule::kRescaled:
      return 2.0 / (1.0 + std::exp(1.0 - depth_ratio)) - 1.0;
    case WeightRule::kPrinted:
      return 1.0 / (1.0 + std::exp(-depth_ratio));
  }
  return 1.0;
}

NavigateOptions::NavigateOptions() {
  map.smooth_px = 2.0;
  map.open_px = 3;
  map.close_px = 15;
  map.fill_holes = false;
  map.max_area = 1.0;
}

void validate(const NavigateOptions& options) {
  validate(options.map);
  if (!(options.window_width > 0.0 && options.window_width <= 1.0 && options.window_height > 0.0 &&
        options.window_height <= 1.0)) {
    throw_invalid("navigate options: give window_width and window_height above 0 and up to 1, as shares of the image");
  }
  if (!(options.delta >= 0.0 && options.floor > 0.0 && options.blocked > 0.0)) {
    throw_invalid("navigate options: give delta of at least 0 and a positive floor and blocked");
  }
  if (!(options.keep >= 1.0)) {
    throw_invalid("navigate options: give keep of at least 1");
  }
  if (options.directions < 1 || options.directions > 64) {
    throw_invalid("navigate options: give directions from 1 to 64");
  }
  if (!(options.min_free_area >= 0.0 && options.min_free_area <= 1.0 && options.min_clearance >= 0.0)) {
    throw_invalid("navigate options: give min_free_area from 0 to 1 and min_clearance of at least 0");
  }
  if (!(options.horizontal_fov_rad > 0.0 && options.horizontal_fov_rad < M_PI && options.max_gap_s > 0.0)) {
    throw_invalid("navigate options: give horizontal_fov_rad between 0 and pi and a positive max_gap_s");
  }
}

NavigatePipeline::NavigatePipeline(const NavigateOptions& options) : options_(options), clock_(options.max_gap_s) {
  validate(options);
}

void NavigatePipeline::reset() noexcept {
  clock_.reset();
  last_free_px_.reset();
}

NavigateResult NavigatePipeline::step(const cv::Mat& map, double time_s, const Eigen::Vector3d& goal_direction,
                                      const std::optional<Eigen::Vector3d>& angular_velocity_rad_s) {
  if (!goal_direction.allFinite() || goal_direction.norm() == 0.0) {
    throw_invalid("goal direction: give a finite vector other than 0");
  }
  NavigateResult result;
  const FrameOrder order = clock_.next(time_s);
  if (order == FrameOrder::kOutOfOrder) {
    result.status = NavigateStatus::kOutOfOrder;
    return result;
  }
  const double dt_s = order == FrameOrder::kNext ? clock_.interval_s() : 0.0;
  if (!is_valid_map(map)) {
    return result;
  }
  const auto camera = geometry::Camera::from_horizontal_fov(map.cols, map.rows, options_.horizontal_fov_rad);
  const bool turns = angular_velocity_rad_s && angular_velocity_rad_s->allFinite() && dt_s > 0.0;
  const Eigen::Vector3d omega = turns ? *angular_velocity_rad_s : Eigen::Vector3d::Zero();
  result.goal_direction = result.free_direction = goal_direction.normalized();
  // The goal is given as of now; the map shows where it was one frame ago.
  result.goal_px = geometry::derotate_pixel(camera, pixel_of(camera, goal_direction), omega, dt_s);
  result.goal_px = {std::clamp(result.goal_px.x(), 0.0, map.cols - 1.0),
                    std::clamp(result.goal_px.y(), 0.0, map.rows - 1.0)};
  result.free_px = result.goal_px;
  result.window = window_about(result.goal_px, map.size(), options_);
  // The window alone tells near from far: the ground below it is nearer than anything that is flown into.
  result.steps = find_regions(map, options_.map, result.window);

  if (result.steps.status == MapStatus::kFlat) {
    // Equal everywhere: nothing near, or nothing to be seen at all. The level tells.
    result.y_close = result.y_other = result.y_free = cv::mean(result.steps.scalar(result.window))[0];
    result.status = result.y_free >= options_.blocked ? NavigateStatus::kBlocked : NavigateStatus::kOk;
    result.weight = result.status == NavigateStatus::kBlocked ? 1.0 : 0.0;
    return result;
  }
  // What stands out but is weak in absolute terms is no obstacle.
  cv::Mat unsafe = result.steps.mask & (result.steps.scalar > 0.5 * options_.floor);
  const double level = map_quantile(result.steps.scalar(result.window), 0.25);
  result.free = largest_free_space(unsafe, result.window, last_free_px_, options_.keep);
  const bool fits = result.free.found && result.free.area_px >= options_.min_free_area * result.window.area() &&
                    result.free.clearance_px >= options_.min_clearance * map.cols;
  weigh(result);
  if (!fits || level >= options_.blocked) {
    result.status = NavigateStatus::kBlocked;
    result.weight = 1.0;
    return result;
  }
  result.free_px = {result.free.center_px.x, result.free.center_px.y};
  last_free_px_ = result.free.center_px;
  result.free_direction =
      geometry::body_from_camera(camera.ray(geometry::rotate_pixel(camera, result.free_px, omega, dt_s)));
  result.status = NavigateStatus::kOk;
  return result;
}

void NavigatePipeline::weigh(NavigateResult& result) const {
  const cv::Rect& window = result.window;
  const int columns = std::min(options_.directions, window.width);
  const int rows = std::clamp(columns * window.height / window.width, 1, window.height);
  // The nearest thing of each cell: the maximum, over parts that are too large for single pixels to count.
  constexpr int kParts = 4;
  cv::Mat parts;
  cv::resize(result.steps.scalar(window), parts, {kParts * columns, kParts * rows}, 0, 0, cv::INTER_AREA);
  cv::Mat cells(rows, columns, CV_32F);
  for (int row = 0; row < rows; ++row) {
    for (int column = 0; column < columns; ++column) {
      double most = 0.0;
      cv::minMaxLoc(parts(cv::Rect(kParts * column, kParts * row, kParts, kParts)), nullptr, &most);
      cells.at<float>(row, column) = static_cast<float>(most);
    }
  }
  const auto box = [&](const cv::Point& cell) {
    const int x0 = cell.x * window.width / columns;
    const int y0 = cell.y * window.height / rows;
    return cv::Rect(window.x + x0, window.y + y0, (cell.x + 1) * window.width / columns - x0,
                    (cell.y + 1) * window.height / rows - y0);
  };
  cv::Point close;
  cv::minMaxLoc(cells, nullptr, &result.y_close, nullptr, &close);
  result.close_box = box(close);
  // Z_o = min(Z_o,i > Z_close + delta): the largest Y that is clearly below the largest.
  const cv::Mat further = cells < result.y_close / (1.0 + options_.delta);
  if (cv::countNonZero(further) > 0) {
    cv::Point other;
    cv::minMaxLoc(cells, nullptr, &result.y_other, nullptr, &other, further);
    result.other_box = box(other);
  } else {
    result.y_other = result.y_close;
  }
  result.y_free = result.free.found ? cv::mean(result.steps.scalar, result.free.mask)[0] : result.y_close;
  result.weight = navigation_weight(options_.weight, result.y_close, result.y_other, result.y_free, options_.floor);
}

}  // namespace ajna::tasks
