// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>

#include "ajna/base/image_view.hpp"

// A network's map is blurred by some pixels, which is as much as a thing has that is still far away. In an enlarged
// picture the blur is the same, and the thing larger: a second look at where the first found something outlines it.

namespace ajna::tasks {

struct CloserLookOptions {
  double enlarge = 8.0;  ///< times, at most: what is large already is enlarged as far as it fits
  int width = 240;       ///< of the enlarged picture, pixels
  int height = 176;
  int margin_px = 4;  ///< about the first look's mask, of the frame: the outline is looked for within
};
/// Throws Error(kInvalidArgument) that names the first option out of range.
void validate(const CloserLookOptions& options);

/// Where a closer look goes.
struct CloserLook {
  cv::Matx23d closer_from_frame;  ///< pixels of the frame to those of the enlarged picture
  cv::Size size;                  ///< of the enlarged picture
};

/// About the middle of a mask. mask: CV_8U, not 0 where something was found; throws Error(kInvalidArgument) for one of
/// another type, or without such a pixel.
CloserLook closer_look_at(const cv::Mat& mask, const CloserLookOptions& options = {});

/// What is seen there. Beyond the frame's edge its last pixels go on. Throws Error(kInvalidArgument) for a view that is
/// no RGB image.
Image enlarge(const ImageView& frame, const CloserLook& look);

/// The outline of what a mask holds, CV_8U, 0 or 255, on the mask's grid: near the mask, the connected region that
/// stands out most of the part above Otsu's threshold, its holes filled.
/// map: scalar uncertainty of a pair of enlarged pictures, CV_32F; mask: the first look's. Empty where nothing stands
/// out, where the map cannot be used or has another size than the look's, and where the region is smaller than a pixel
/// of the frame.
cv::Mat outline(const cv::Mat& map, const cv::Mat& mask, const CloserLook& look, const CloserLookOptions& options = {});

}  // namespace ajna::tasks
