// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>

#include "ajna/base/image_view.hpp"
#include "ajna/tasks/uncertainty_map.hpp"

namespace ajna::tasks {

enum class SegmentStatus {
  kOk,
  kNoObject,      ///< nothing stands out of the map: no attention, hence no segmentation
  kInvalidInput,  ///< a map or frame that cannot be used, or sizes that differ
};
const char* to_string(SegmentStatus status) noexcept;

/// The segmentation that grows from the attention mask.
enum class SegmentMethod {
  kWatershed,  ///< floods the image's gradient from inside and outside
  kGrabCut,    ///< colour models of inside and outside, cut between them: finer, and far slower
};

const char* to_string(SegmentMethod method) noexcept;

struct SegmentOptions {
  MapOptions map;             ///< for the rims of a pile, joined to one region
  double min_contrast = 1.3;  ///< a region's mean over the mean outside
  double join = 0.12;         ///< regions nearer than this to the largest belong to the pile, share of the diagonal
  SegmentMethod method = SegmentMethod::kWatershed;
  double inner = 0.35;  ///< the sure inside is the attention's hull, eroded by this share of its own depth
  double outer = 0.10;  ///< the sure outside begins this far from the hull, share of its diameter
  int grabcut_iterations = 1;
  int side_px = 160;  ///< the outline is found on a copy no wider than this

  SegmentOptions();
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const SegmentOptions& options);

struct SegmentResult {
  SegmentStatus status = SegmentStatus::kInvalidInput;
  MapSteps steps;
  cv::Mat attention;     ///< CV_8U, 0 or 255: what the uncertainty says, nothing else
  cv::Mat seeds;         ///< CV_8U: 255 sure inside, 0 sure outside, 128 to be decided
  cv::Mat segmentation;  ///< CV_8U, 0 or 255: what the image's colours make of the seeds
  cv::Rect box;          ///< of the attention mask
};

/// Where a pile of objects lies, from one pair of views, and, apart from that, its outline. The uncertainty alone shows
/// the place; the outline is a second step, seeded by it.
/// frame: the first frame of the pair, RGB; map: CV_32F, its scalar uncertainty.
SegmentResult segment_pile(const ImageView& frame, const cv::Mat& map, const SegmentOptions& options = {});

}  // namespace ajna::tasks
