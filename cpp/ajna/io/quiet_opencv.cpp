// SPDX-License-Identifier: MIT
#include "ajna/io/quiet_opencv.hpp"

#include <opencv2/core/utils/logger.hpp>

namespace ajna::io {
namespace logging = cv::utils::logging;

QuietOpenCv::QuietOpenCv() : level_(logging::setLogLevel(logging::LOG_LEVEL_SILENT)) {}
QuietOpenCv::~QuietOpenCv() { logging::setLogLevel(static_cast<logging::LogLevel>(level_)); }

}  // namespace ajna::io
