// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core/utils/logger.hpp>

namespace ajna::io {

/// Silences OpenCV's own log for a scope: what fails is reported once, by an ajna::Error, not by a dozen warnings of
/// the backends that were tried. Private to io: it includes OpenCV.
class QuietOpenCv {
 public:
  QuietOpenCv() : level_(cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT)) {}
  ~QuietOpenCv() { cv::utils::logging::setLogLevel(level_); }
  QuietOpenCv(const QuietOpenCv&) = delete;
  QuietOpenCv& operator=(const QuietOpenCv&) = delete;

 private:
  cv::utils::logging::LogLevel level_;
};

}  // namespace ajna::io
