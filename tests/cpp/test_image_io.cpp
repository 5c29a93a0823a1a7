// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <random>

#include "ajna/io/image_io.hpp"
#include "io_files.hpp"

namespace ajna::io {
namespace fs = std::filesystem;
namespace {

using testing::get;
using testing::make_png;
using testing::put;
using testing::TempFolder;

Image random_image(int width, int height, unsigned seed) {
  Image image(width, height);
  std::mt19937 random(seed);
  std::generate_n(image.data(), image.size_bytes(), [&] { return static_cast<std::uint8_t>(random()); });
  return image;
}

std::vector<int> pixel(const Image& image, int x, int y) {
  const std::uint8_t* p = image.data() + 3 * (y * image.width() + x);
  return {p[0], p[1], p[2]};
}

bool equal(const Image& a, const Image& b) {
  return a.width() == b.width() && a.height() == b.height() && std::memcmp(a.data(), b.data(), a.size_bytes()) == 0;
}

TEST(ImageIo, LosslessFormatsRoundTripAtManySizes) {
  const TempFolder folder;
  for (const char* name : {"a.png", "a.bmp", "a.ppm", "A.PNG"}) {
    for (const auto& [width, height] : {std::pair{1, 1}, {1, 7}, {5, 3}, {64, 48}, {33, 2}}) {
      const Image image = random_image(width, height, 7U * static_cast<unsigned>(width + height));
      write_image(folder / name, image.view());
      EXPECT_TRUE(equal(read_image(folder / name), image)) << name << " " << width << "x" << height;
    }
  }
  EXPECT_EQ(folder.entries(), 4U) << "temporary files were left behind";
}

TEST(ImageIo, WritesRowsOfAStridedView) {
  const TempFolder folder;
  const Image image = random_image(8, 6, 3);
  ImageView crop = image.view();
  crop.data += 2 * crop.row_stride + 3 * 3;
  crop.width = 4;
  crop.height = 3;
  write_image(folder / "crop.png", crop);
  const Image read = read_image(folder / "crop.png");
  for (int y = 0; y < 3; ++y) {
    for (int x = 0; x < 4; ++x) {
      EXPECT_EQ(pixel(read, x, y), pixel(image, x + 3, y + 2));
    }
  }
}

TEST(ImageIo, PpmIsByteExact) {
  const TempFolder folder;
  Image image(2, 1);
  const testing::Bytes samples = {1, 2, 3, 250, 251, 252};
  std::copy(samples.begin(), samples.end(), image.data());
  write_image(folder / "a.ppm", image.view());
  const testing::Bytes bytes = get(folder / "a.ppm");
  const std::string header = "P6\n2 1\n255\n";
  ASSERT_EQ(bytes.size(), header.size() + 6);
  EXPECT_EQ(std::string(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(header.size())), header);
  EXPECT_TRUE(std::equal(samples.begin(), samples.end(), bytes.begin() + static_cast<std::ptrdiff_t>(header.size())));
}

TEST(ImageIo, ReadsRgbOrderFromAnIndependentPng) {
  const TempFolder folder;
  put(folder / "rgb.png", make_png(2, 1, 8, 2, {{10, 20, 30, 200, 100, 0}}));
  const Image image = read_image(folder / "rgb.png");
  EXPECT_EQ(pixel(image, 0, 0), (std::vector<int>{10, 20, 30}));
  EXPECT_EQ(pixel(image, 1, 0), (std::vector<int>{200, 100, 0}));
}

TEST(ImageIo, GreyBecomesRgbAndAlphaIsDropped) {
  const TempFolder folder;
  put(folder / "grey.png", make_png(2, 1, 8, 0, {{7, 255}}));
  EXPECT_EQ(pixel(read_image(folder / "grey.png"), 0, 0), (std::vector<int>{7, 7, 7}));
  put(folder / "rgba.png", make_png(1, 1, 8, 6, {{10, 20, 30, 0}}));
  EXPECT_EQ(pixel(read_image(folder / "rgba.png"), 0, 0), (std::vector<int>{10, 20, 30}));
  put(folder / "grey_alpha.png", make_png(1, 1, 8, 4, {{99, 128}}));
  EXPECT_EQ(pixel(read_image(folder / "grey_alpha.png"), 0, 0), (std::vector<int>{99, 99, 99}));
}

TEST(ImageIo, SixteenBitsAreRoundedToEight) {
  const TempFolder folder;
  // 0x8000 / 257 = 127.50 and 0x8130 / 257 = 128.68: both above the half, so both round up.
  put(folder / "deep.png", make_png(1, 1, 16, 2, {{0xFF, 0xFF, 0x80, 0x00, 0x81, 0x30}}));
  EXPECT_EQ(pixel(read_image(folder / "deep.png"), 0, 0), (std::vector<int>{255, 128, 129}));
  put(folder / "deep_grey.png", make_png(1, 1, 16, 0, {{0x40, 0x40}}));
  EXPECT_EQ(pixel(read_image(folder / "deep_grey.png"), 0, 0), (std::vector<int>{64, 64, 64}));
  testing::Bytes ppm = {'P', '6', '\n', '1', ' ', '1', '\n', '6', '5', '5', '3', '5', '\n'};
  ppm.insert(ppm.end(), {0xFF, 0xFF, 0x80, 0x00, 0x81, 0x30});
  put(folder / "deep.ppm", ppm);
  EXPECT_EQ(pixel(read_image(folder / "deep.ppm"), 0, 0), (std::vector<int>{255, 128, 129}));
}

TEST(ImageIo, ReadsTextPnmWithCommentsAndOddScales) {
  const TempFolder folder;
  put(folder / "a.ppm", "P3 # made by hand\n# another\n2 1\n100\n0 50 100\n100 0 1\n");
  const Image image = read_image(folder / "a.ppm");
  EXPECT_EQ(pixel(image, 0, 0), (std::vector<int>{0, 128, 255}));
  EXPECT_EQ(pixel(image, 1, 0), (std::vector<int>{255, 0, 3}));
  put(folder / "b.pgm", "P2\n1 1\n15\n15\n");
  EXPECT_EQ(pixel(read_image(folder / "b.pgm"), 0, 0), (std::vector<int>{255, 255, 255}));
  put(folder / "c.ppm", "P3 1 1 100 101 0 0");
  AJNA_EXPECT_ERROR(read_image(folder / "c.ppm"), ErrorKind::kInvalidArgument, "sample of 101");
}

TEST(ImageIo, JpegComesBackNearlyEqual) {
  const TempFolder folder;
  Image image(32, 24);
  for (int i = 0; i < 32 * 24; ++i) {
    image.data()[3 * i] = static_cast<std::uint8_t>(4 * (i % 32));
    image.data()[3 * i + 1] = 60;
    image.data()[3 * i + 2] = 200;
  }
  write_image(folder / "a.jpg", image.view());
  const Image read = read_image(folder / "a.jpg");
  ASSERT_EQ(read.width(), 32);
  for (std::size_t i = 0; i < image.size_bytes(); ++i) {
    EXPECT_NEAR(read.data()[i], image.data()[i], 12);
  }
}

TEST(ImageIo, FormatIsRecognisedByContentNotByName) {
  const TempFolder folder;
  put(folder / "png_named.jpg", make_png(1, 1, 8, 2, {{1, 2, 3}}));
  EXPECT_EQ(pixel(read_image(folder / "png_named.jpg"), 0, 0), (std::vector<int>{1, 2, 3}));
}

TEST(ImageIo, EveryTruncationIsRefused) {
  const TempFolder folder;
  const Image image = random_image(9, 7, 11);
  for (const char* extension : {".png", ".jpg", ".bmp", ".ppm"}) {
    const fs::path whole = folder / (std::string("whole") + extension);
    write_image(whole, image.view());
    const testing::Bytes bytes = get(whole);
    ASSERT_NO_THROW(read_image(whole));
    for (std::size_t length = 0; length < bytes.size(); ++length) {
      put(folder / "cut", testing::Bytes(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(length)));
      AJNA_EXPECT_ERROR(read_image(folder / "cut"), ErrorKind::kInvalidArgument, "cut'");
    }
  }
}

TEST(ImageIo, NoSingleDamagedByteCrashesAndPngNoticesEach) {
  const TempFolder folder;
  const testing::Bytes png = make_png(3, 2, 8, 2, {{1, 2, 3, 4, 5, 6, 7, 8, 9}, {9, 8, 7, 6, 5, 4, 3, 2, 1}});
  for (std::size_t i = 0; i < png.size(); ++i) {
    testing::Bytes damaged = png;
    damaged[i] ^= 0x41;
    put(folder / "damaged", damaged);
    EXPECT_THROW(read_image(folder / "damaged"), Error) << "byte " << i;
  }
  const Image image = random_image(9, 7, 11);
  std::mt19937 random(5);
  for (const char* extension : {".jpg", ".bmp", ".ppm"}) {
    const fs::path whole = folder / (std::string("whole") + extension);
    write_image(whole, image.view());
    const testing::Bytes bytes = get(whole);
    for (int trial = 0; trial < 200; ++trial) {
      testing::Bytes damaged = bytes;
      damaged[random() % bytes.size()] = static_cast<std::uint8_t>(random());
      put(folder / "damaged", damaged);
      try {
        read_image(folder / "damaged");  // a changed sample is legal; only ajna::Error may leave
      } catch (const Error&) {
      }
    }
  }
}

TEST(ImageIo, LyingAndAbsurdSizesAreRefused) {
  const TempFolder folder;
  put(folder / "zero.png", make_png(0, 1, 8, 2, {{}}));
  AJNA_EXPECT_ERROR(read_image(folder / "zero.png"), ErrorKind::kInvalidArgument, "0x1");
  put(folder / "huge.png", make_png(2'000'000'000, 2'000'000'000, 8, 2, {{1, 2, 3}}));
  AJNA_EXPECT_ERROR(read_image(folder / "huge.png"), ErrorKind::kInvalidArgument, "2000000000x2000000000");
  put(folder / "short.png", make_png(4, 4, 8, 2, {{1, 2, 3}}));
  AJNA_EXPECT_ERROR(read_image(folder / "short.png"), ErrorKind::kInvalidArgument, "damaged");
  put(folder / "huge.ppm", "P6 99999 99999 255 abc");
  AJNA_EXPECT_ERROR(read_image(folder / "huge.ppm"), ErrorKind::kInvalidArgument, "99999x99999");
  put(folder / "wrap.ppm", "P6 99999999999999999999 1 255 abc");
  AJNA_EXPECT_ERROR(read_image(folder / "wrap.ppm"), ErrorKind::kInvalidArgument, "absurd width");
  put(folder / "negative.ppm", "P6 -3 1 255 abc");
  AJNA_EXPECT_ERROR(read_image(folder / "negative.ppm"), ErrorKind::kInvalidArgument, "not a number");
}

TEST(ImageIo, WhatIsNoImageIsNamed) {
  const TempFolder folder;
  AJNA_EXPECT_ERROR(read_image(folder / "missing.png"), ErrorKind::kFileNotFound, "does not exist");
  AJNA_EXPECT_ERROR(read_image(folder.path()), ErrorKind::kInvalidArgument, "is a folder");
  put(folder / "text.png", "this is not a picture\n");
  AJNA_EXPECT_ERROR(read_image(folder / "text.png"), ErrorKind::kInvalidArgument, "is not an image but text");
  put(folder / "empty.png", "");
  AJNA_EXPECT_ERROR(read_image(folder / "empty.png"), ErrorKind::kInvalidArgument, "is empty");
  AJNA_EXPECT_ERROR(read_image("/dev/null"), ErrorKind::kInvalidArgument, "device or a pipe");
  AJNA_EXPECT_ERROR(read_image(folder / "text.png" / "below.png"), ErrorKind::kFileNotFound, "does not exist");
}

TEST(ImageIo, WhereNothingCanBeWrittenNothingIsLeft) {
  const TempFolder folder;
  const Image image(4, 4);
  AJNA_EXPECT_ERROR(write_image(folder / "a.gif", image.view()), ErrorKind::kInvalidArgument, "extension '.gif'");
  AJNA_EXPECT_ERROR(write_image(folder / "a", image.view()), ErrorKind::kInvalidArgument, "extension ''");
  AJNA_EXPECT_ERROR(write_image(folder / "a.png", ImageView{}), ErrorKind::kInvalidArgument, "0x0");
  AJNA_EXPECT_ERROR(write_image(folder / "no/a.png", image.view()), ErrorKind::kFileNotFound, "output folder");
  put(folder / "file", "x");
  AJNA_EXPECT_ERROR(write_image(folder / "file/a.png", image.view()), ErrorKind::kInvalidArgument, "not a folder");
  fs::create_directory(folder / "taken.png");
  AJNA_EXPECT_ERROR(write_image(folder / "taken.png", image.view()), ErrorKind::kInvalidArgument, "is a folder");
  EXPECT_THROW(write_image("/proc/a.png", image.view()), Error);
  EXPECT_EQ(folder.entries(), 2U);
}

TEST(ImageIo, AnOldFileSurvivesAFailedWrite) {
  const TempFolder folder;
  const Image image = random_image(4, 4, 1);
  write_image(folder / "a.png", image.view());
  ImageView grey = image.view();
  grey.channels = 1;
  EXPECT_THROW(write_image(folder / "a.png", grey), Error);
  EXPECT_TRUE(equal(read_image(folder / "a.png"), image));
}

}  // namespace
}  // namespace ajna::io
