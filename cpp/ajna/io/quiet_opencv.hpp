// SPDX-License-Identifier: MIT
#pragma once

namespace ajna::io {

/// Silences OpenCV's own log for a scope: what fails is reported once, by an ajna::Error, not by a dozen warnings of
/// the backends that were tried. The level is one per process, so other threads' warnings are lost meanwhile.
class QuietOpenCv {
 public:
  QuietOpenCv();
  ~QuietOpenCv();
  QuietOpenCv(const QuietOpenCv&) = delete;
  QuietOpenCv& operator=(const QuietOpenCv&) = delete;

 private:
  int level_;  ///< cv::utils::logging::LogLevel to go back to; an int keeps OpenCV out of the header
};

}  // namespace ajna::io
