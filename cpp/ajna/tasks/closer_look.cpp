// SPDX-License-Identifier: MIT
#include "ajna/tasks/closer_look.hpp"

#include <algorithm>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/base/range.hpp"
#include "ajna/tasks/frame_mat.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {
namespace {

constexpr double kFilled = 0.7;       // of the enlarged picture, by the mask at most
constexpr double kLeastRange = 1e-6;  // of a map in which something stands out

void check(const cv::Mat& mask) {
  if (mask.empty() || mask.type() != CV_8U || cv::countNonZero(mask) == 0) {
    throw_invalid("closer look: give a mask of type CV_8U that holds something");
  }
}

/// 0 to 1 over the values of the map where `where` is not 0, as a row; empty where they are all alike.
cv::Mat values_of(const cv::Mat& map, const cv::Mat& where, double& low, double& high) {
  cv::minMaxLoc(map, &low, &high, nullptr, nullptr, where);
  if (high - low < kLeastRange) {
    return {};
  }
  cv::Mat row(1, cv::countNonZero(where), CV_32F);
  auto* out = row.ptr<float>();
  for (int y = 0; y < map.rows; ++y) {
    const auto* values = map.ptr<float>(y);
    const auto* counted = where.ptr<std::uint8_t>(y);
    for (int x = 0; x < map.cols; ++x) {
      if (counted[x] != 0) {
        *out++ = static_cast<float>((values[x] - low) / (high - low));
      }
    }
  }
  return row;
}

/// Of the regions of a mask the one with the largest sum of what lies above the threshold.
cv::Mat strongest(const cv::Mat& mask, const cv::Mat& map, double threshold) {
  cv::Mat labels;
  const int count = cv::connectedComponents(mask, labels, 8, CV_32S);
  std::vector<double> sums(static_cast<std::size_t>(count), 0.0);
  for (int y = 0; y < map.rows; ++y) {
    const auto* label = labels.ptr<int>(y);
    const auto* value = map.ptr<float>(y);
    for (int x = 0; x < map.cols; ++x) {
      if (label[x] != 0) {
        sums[static_cast<std::size_t>(label[x])] += value[x] - threshold;
      }
    }
  }
  sums[0] = -1.0;  // what is in none
  const auto best = std::max_element(sums.begin(), sums.end()) - sums.begin();
  return labels == static_cast<int>(best);
}

}  // namespace

void validate(const CloserLookOptions& options) {
  require_between("closer_look.enlarge", options.enlarge, 1.0, 32.0);
  require_between("closer_look.width", options.width, 32, 4096);
  require_between("closer_look.height", options.height, 32, 4096);
  require_between("closer_look.margin_px", options.margin_px, 0, 100);
}

CloserLook closer_look_at(const cv::Mat& mask, const CloserLookOptions& options) {
  validate(options);
  check(mask);
  const cv::Rect box = cv::boundingRect(mask);
  const double fits = kFilled * std::min(static_cast<double>(options.width) / box.width,
                                         static_cast<double>(options.height) / box.height);
  const double scale = std::clamp(fits, 1.0, options.enlarge);
  const cv::Point2d middle(box.x + 0.5 * (box.width - 1), box.y + 0.5 * (box.height - 1));
  CloserLook look;
  look.size = {options.width, options.height};
  look.closer_from_frame = {scale, 0.0,   0.5 * (options.width - 1) - scale * middle.x,
                            0.0,   scale, 0.5 * (options.height - 1) - scale * middle.y};
  return look;
}

Image enlarge(const ImageView& frame, const CloserLook& look) {
  const cv::Mat pixels = frame_mat(frame);
  if (pixels.empty()) {
    throw_invalid("closer look: give an RGB frame");
  }
  Image result(look.size.width, look.size.height);
  cv::Mat enlarged(look.size, CV_8UC3, result.data());
  cv::warpAffine(pixels, enlarged, look.closer_from_frame, look.size, cv::INTER_LINEAR, cv::BORDER_REPLICATE);
  return result;
}

cv::Mat outline(const cv::Mat& map, const cv::Mat& mask, const CloserLook& look, const CloserLookOptions& options) {
  validate(options);
  check(mask);
  if (!is_valid_map(map) || map.size() != look.size) {
    return {};
  }
  const int side = 2 * options.margin_px + 1;
  cv::Mat wider;
  cv::dilate(mask, wider, cv::getStructuringElement(cv::MORPH_RECT, {side, side}));
  wider = wider != 0;
  cv::Mat searched;
  cv::warpAffine(wider, searched, look.closer_from_frame, look.size);
  searched = searched > 127;
  double low = 0.0;
  double high = 0.0;
  const cv::Mat values = cv::countNonZero(searched) == 0 ? cv::Mat() : values_of(map, searched, low, high);
  if (values.empty()) {
    return {};
  }
  MapOptions rule;
  rule.rule = ThresholdRule::kOtsu;
  const double threshold = low + threshold_of(values, rule) * (high - low);
  const cv::Mat region = morphology(strongest((map > threshold) & searched, map, threshold), 0, 0, true);
  cv::Mat result;
  cv::warpAffine(region, result, look.closer_from_frame, mask.size(), cv::INTER_LINEAR | cv::WARP_INVERSE_MAP);
  result = result > 127;
  return cv::countNonZero(result) == 0 ? cv::Mat() : result;
}

}  // namespace ajna::tasks
