// SPDX-License-Identifier: MIT
#include "ajna/io/image_io.hpp"

#include <algorithm>
#include <cctype>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <string>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/io/image_header.hpp"
#include "ajna/io/pnm.hpp"

namespace ajna::io {
namespace {

constexpr std::size_t kMaxImageBytes = std::size_t{1} << 30;

}  // namespace

Image read_image(const std::filesystem::path& path) {
  const std::string name = path.string();
  const Bytes bytes = read_file(path, kMaxImageBytes);
  const ImageHeader header = check_image_file(bytes, name);
  if (header.format == ImageFormat::kPnm) {
    return decode_pnm(bytes, name);
  }
  cv::Mat bgr;
  try {
    bgr = cv::imdecode(bytes, cv::IMREAD_COLOR | cv::IMREAD_ANYDEPTH);
    if (bgr.depth() == CV_16U) {
      bgr.convertTo(bgr, CV_8U, 1.0 / 257.0);
    }
  } catch (const cv::Exception&) {
    bgr.release();
  }
  if (bgr.empty() || bgr.type() != CV_8UC3) {
    throw_invalid("image '" + name + "' is damaged (its pixels cannot be decoded): get a good copy");
  }
  Image image(bgr.cols, bgr.rows);
  cv::Mat rgb(bgr.rows, bgr.cols, CV_8UC3, image.data());
  cv::cvtColor(bgr, rgb, cv::COLOR_BGR2RGB);
  return image;
}

void write_image(const std::filesystem::path& path, const ImageView& image) {
  const std::string name = path.string();
  if (image.empty() || image.channels != 3) {
    throw_invalid("image for '" + name + "' is " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                  " with " + std::to_string(image.channels) + " channels: give a non-empty RGB image");
  }
  std::string extension = path.extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  if (extension != ".png" && extension != ".jpg" && extension != ".jpeg" && extension != ".bmp" &&
      extension != ".ppm") {
    throw_invalid("image file '" + name + "' has the unknown extension '" + extension +
                  "': use .png, .jpg, .bmp or .ppm");
  }
  // OpenCV takes no const data; cvtColor only reads from it.
  const cv::Mat rgb(image.height, image.width, CV_8UC3, const_cast<std::uint8_t*>(image.data),
                    static_cast<std::size_t>(image.row_stride));
  Bytes bytes;
  bool encoded = false;
  try {
    cv::Mat bgr;
    cv::cvtColor(rgb, bgr, cv::COLOR_RGB2BGR);
    encoded = cv::imencode(extension, bgr, bytes);
  } catch (const cv::Exception&) {
    encoded = false;
  }
  if (!encoded) {
    throw_runtime("image '" + name + "' of " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                  " cannot be encoded as " + extension + ": choose another format");
  }
  write_file_atomically(path, bytes.data(), bytes.size());
}

Image resize_image(const ImageView& image, int width, int height) {
  if (image.empty() || image.channels != 3 || width < 1 || height < 1) {
    throw_invalid("cannot resize an image of " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                  " to " + std::to_string(width) + "x" + std::to_string(height) + ": give a non-empty RGB image and " +
                  "sides of at least 1");
  }
  const cv::Mat from(image.height, image.width, CV_8UC3, const_cast<std::uint8_t*>(image.data),
                     static_cast<std::size_t>(image.row_stride));
  Image result(width, height);
  cv::Mat to(height, width, CV_8UC3, result.data());
  cv::resize(from, to, to.size(), 0, 0, cv::INTER_AREA);
  return result;
}

}  // namespace ajna::io
