// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "ajna/io/image_io.hpp"
#include "ajna/io/video_source.hpp"
#include "ajna/io/video_writer.hpp"
#include "io_files.hpp"

namespace ajna::io {
namespace {

namespace fs = std::filesystem;
using testing::Bytes;
using testing::get;
using testing::put;
using testing::TempFolder;

Image flat(int width, int height, int red, int green, int blue) {
  Image image(width, height);
  for (std::size_t i = 0; i < image.size_bytes(); i += 3) {
    image.data()[i] = static_cast<std::uint8_t>(red);
    image.data()[i + 1] = static_cast<std::uint8_t>(green);
    image.data()[i + 2] = static_cast<std::uint8_t>(blue);
  }
  return image;
}

TEST(NaturalOrder, NumbersCompareByValue) {
  std::vector<std::string> names = {"f10.png",
                                    "f9.png",
                                    "f1.png",
                                    "g1.png",
                                    "f01b.png",
                                    "f1b.png",
                                    "f99999999999999999999999.png",
                                    "f100000000000000000000000.png",
                                    "f.png"};
  std::sort(names.begin(), names.end(), natural_less);
  EXPECT_EQ(names,
            (std::vector<std::string>{"f.png", "f1.png", "f01b.png", "f1b.png", "f9.png", "f10.png",
                                      "f99999999999999999999999.png", "f100000000000000000000000.png", "g1.png"}));
}

TEST(NaturalOrder, IsAStrictWeakOrder) {
  const std::vector<std::string> names = {"",    "0",   "00",   "1",    "01",    "a", "a0", "a00", "a1",
                                          "a01", "a1b", "a01b", "a1b2", "a01b2", "b", "A",  "a-1", "a 1"};
  for (const auto& a : names) {
    EXPECT_FALSE(natural_less(a, a));
    for (const auto& b : names) {
      EXPECT_EQ(natural_less(a, b) || natural_less(b, a), a != b) << a << " | " << b;
      EXPECT_FALSE(natural_less(a, b) && natural_less(b, a));
      for (const auto& c : names) {
        EXPECT_TRUE(!(natural_less(a, b) && natural_less(b, c)) || natural_less(a, c)) << a << b << c;
      }
    }
  }
}

TEST(VideoSource, FolderGivesItsImagesInNaturalOrder) {
  const TempFolder folder;
  for (const int i : {10, 2, 1}) {
    write_image(folder / ("frame_" + std::to_string(i) + ".png"), flat(6, 4, i, 0, 0).view());
  }
  put(folder / "notes.txt", "not a frame");
  put(folder / ".hidden.png", "not a frame");
  fs::create_directory(folder / "sub.png");
  VideoSource source(folder.path().string(), 10.0);
  EXPECT_EQ(source.width(), 6);
  EXPECT_EQ(source.height(), 4);
  EXPECT_EQ(source.frame_count(), 3);
  EXPECT_DOUBLE_EQ(source.fps(), 10.0);
  EXPECT_FALSE(source.is_camera());
  const std::vector<int> order = {1, 2, 10};
  for (std::size_t i = 0; i < order.size(); ++i) {
    const auto frame = source.next();
    ASSERT_TRUE(frame.has_value());
    EXPECT_EQ(frame->image.data()[0], order[i]);
    EXPECT_EQ(frame->index, static_cast<std::int64_t>(i));
    EXPECT_DOUBLE_EQ(frame->timestamp_s, 0.1 * static_cast<double>(i));
    EXPECT_EQ(frame->name, "frame_" + std::to_string(order[i]) + ".png");
  }
  EXPECT_FALSE(source.next().has_value());
  EXPECT_FALSE(source.next().has_value());
}

TEST(VideoSource, BadSourcesEachHaveTheirSentence) {
  const TempFolder folder;
  fs::create_directory(folder / "empty");
  const auto open = [&](const std::string& name) { VideoSource source((folder / name).string()); };
  AJNA_EXPECT_ERROR((open("empty"), 0), ErrorKind::kInvalidArgument, "holds no images");
  AJNA_EXPECT_ERROR((open("missing.mp4"), 0), ErrorKind::kFileNotFound, "missing.mp4");
  put(folder / "text_01.mp4", "this is not a video");
  AJNA_EXPECT_ERROR((open("text_01.mp4"), 0), ErrorKind::kInvalidArgument, "not a readable video");
  put(folder / "zero.avi", "");
  AJNA_EXPECT_ERROR((open("zero.avi"), 0), ErrorKind::kInvalidArgument, "zero.avi");
  write_image(folder / "one.png", flat(4, 4, 0, 0, 0).view());
  AJNA_EXPECT_ERROR((open("one.png"), 0), ErrorKind::kInvalidArgument, "single image");
  AJNA_EXPECT_ERROR((VideoSource("")), ErrorKind::kInvalidArgument, "empty");
  AJNA_EXPECT_ERROR((VideoSource("99999999999")), ErrorKind::kInvalidArgument, "camera index");
  AJNA_EXPECT_ERROR((VideoSource("987")), ErrorKind::kRuntime, "camera 987");
  AJNA_EXPECT_ERROR((VideoSource("/dev/null")), ErrorKind::kInvalidArgument, "device or a pipe");
  for (const double fps : {0.0, -1.0, std::nan(""), 1e9}) {
    AJNA_EXPECT_ERROR((VideoSource(folder.path().string(), fps)), ErrorKind::kInvalidArgument, "fps");
  }
}

TEST(VideoSource, DamagedOrUnequalFramesStopTheFolder) {
  const TempFolder folder;
  write_image(folder / "1.png", flat(6, 4, 1, 2, 3).view());
  write_image(folder / "2.png", flat(4, 6, 1, 2, 3).view());
  put(folder / "3.png", "text");
  VideoSource source(folder.path().string());
  EXPECT_TRUE(source.next().has_value());
  AJNA_EXPECT_ERROR(source.next(), ErrorKind::kInvalidArgument, "'2.png'");
  AJNA_EXPECT_ERROR(source.next(), ErrorKind::kInvalidArgument, "3.png");
  EXPECT_FALSE(source.next().has_value());
  fs::remove(folder / "1.png");
  fs::remove(folder / "2.png");
  AJNA_EXPECT_ERROR((VideoSource(folder.path().string())), ErrorKind::kInvalidArgument, "3.png");
}

TEST(Video, WritesAndReadsBack) {
  const TempFolder folder;
  for (const char* name : {"a.mp4", "a.avi"}) {
    VideoWriter writer(folder / name, 65, 49, 25.0);  // odd sides grow by one
    for (int i = 0; i < 5; ++i) {
      writer.write(flat(65, 49, 40 * i, 128, 30).view());
    }
    EXPECT_FALSE(fs::exists(folder / name)) << "visible before it is complete";
    writer.close();
    writer.close();
    EXPECT_EQ(writer.frames_written(), 5);
    VideoSource source((folder / name).string());
    EXPECT_EQ(source.width(), 66);
    EXPECT_EQ(source.height(), 50);
    EXPECT_EQ(source.frame_count(), 5);
    EXPECT_NEAR(source.fps(), 25.0, 1e-6);
    int count = 0;
    while (const auto frame = source.next()) {
      EXPECT_NEAR(frame->image.data()[0], 40 * count, 16);
      EXPECT_NEAR(frame->image.data()[2], 30, 16);
      EXPECT_NEAR(frame->timestamp_s, count / 25.0, 1e-3);
      ++count;
    }
    EXPECT_EQ(count, 5);
  }
  EXPECT_EQ(folder.entries(), 2U);
}

TEST(Video, NothingIsLeftWithoutClose) {
  const TempFolder folder;
  {
    VideoWriter writer(folder / "a.mp4", 32, 32, 10.0);
    writer.write(flat(32, 32, 0, 0, 0).view());
    AJNA_EXPECT_ERROR((writer.write(flat(32, 30, 0, 0, 0).view()), 0), ErrorKind::kInvalidArgument, "32x30");
    VideoWriter moved = std::move(writer);
    EXPECT_EQ(folder.entries(), 1U);
  }
  EXPECT_EQ(folder.entries(), 0U);
  {
    VideoWriter writer(folder / "a.mp4", 32, 32, 10.0);
    AJNA_EXPECT_ERROR((writer.close(), 0), ErrorKind::kInvalidArgument, "no frames");
  }
  AJNA_EXPECT_ERROR((VideoWriter(folder / "a.gif", 32, 32, 10.0)), ErrorKind::kInvalidArgument, "'.gif'");
  AJNA_EXPECT_ERROR((VideoWriter(folder / "a.mp4", 0, 32, 10.0)), ErrorKind::kInvalidArgument, "0x32");
  AJNA_EXPECT_ERROR((VideoWriter(folder / "a.mp4", 32, 32, 0.0)), ErrorKind::kInvalidArgument, "frames per second");
  AJNA_EXPECT_ERROR((VideoWriter(folder / "no/a.mp4", 32, 32, 9.0)), ErrorKind::kFileNotFound, "output folder");
  EXPECT_EQ(folder.entries(), 0U);
}

TEST(Video, TruncatedFilesGiveAnErrorOrFewerFramesNeverACrash) {
  const TempFolder folder;
  {
    VideoWriter writer(folder / "a.mp4", 32, 32, 10.0);
    for (int i = 0; i < 3; ++i) {
      writer.write(flat(32, 32, 80 * i, 0, 0).view());
    }
    writer.close();
  }
  const Bytes whole = get(folder / "a.mp4");
  for (std::size_t length = 1; length < whole.size(); length += 97) {
    put(folder / "cut.mp4", Bytes(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(length)));
    try {
      VideoSource source((folder / "cut.mp4").string());
      int count = 0;
      while (source.next()) {
        ++count;
      }
      EXPECT_LE(count, 3);
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    }
  }
}

}  // namespace
}  // namespace ajna::io
