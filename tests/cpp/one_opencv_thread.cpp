// SPDX-License-Identifier: MIT
// Linked into tests that are built with the thread sanitizer: OpenCV's threads (TBB) hand memory to each other by locks
// that the sanitizer does not see, and none of our code runs on them.

#include <opencv2/core/utility.hpp>

namespace {

const bool kOneThread = [] {
  cv::setNumThreads(1);
  return true;
}();

}  // namespace
