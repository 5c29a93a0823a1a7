// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "ajna/io/flow_io.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/pfm_io.hpp"
#include "io_files.hpp"

namespace ajna::io {
namespace {

namespace fs = std::filesystem;
using testing::Bytes;
using testing::get;
using testing::make_png;
using testing::put;
using testing::TempFolder;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

template <typename T>
void append(Bytes& bytes, T value) {  // the tests run on little-endian machines
  const auto* p = reinterpret_cast<const std::uint8_t*>(&value);
  bytes.insert(bytes.end(), p, p + sizeof value);
}

Bytes make_flo(std::int32_t width, std::int32_t height, const std::vector<float>& values, float magic = 202021.25F) {
  Bytes bytes;
  append(bytes, magic);
  append(bytes, width);
  append(bytes, height);
  for (const float value : values) {
    append(bytes, value);
  }
  return bytes;
}

std::vector<float> random_values(std::size_t count, float scale, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> uniform(-scale, scale);
  std::vector<float> values(count);
  for (float& value : values) {
    value = uniform(random);
  }
  return values;
}

TEST(Flo, IsByteExactBothWays) {
  const TempFolder folder;
  const std::vector<float> values = {1.5F, -2.25F, 0.0F, 1e-20F, 300.0F, -0.0F};
  write_flo(folder / "a.flo", {values.data(), nullptr, 3, 1});
  const Bytes bytes = get(folder / "a.flo");
  EXPECT_EQ(bytes, make_flo(3, 1, values));
  EXPECT_EQ(std::string(bytes.begin(), bytes.begin() + 4), "PIEH");
  const FlowImage read = read_flo(folder / "a.flo");
  EXPECT_EQ(read.width, 3);
  EXPECT_EQ(read.height, 1);
  EXPECT_EQ(std::memcmp(read.flow.data(), values.data(), sizeof(float) * values.size()), 0);
  EXPECT_EQ(read.valid, (std::vector<std::uint8_t>{1, 1, 1}));
}

TEST(Flo, RoundTripsAtManySizes) {
  const TempFolder folder;
  for (const auto& [width, height] : {std::pair{1, 1}, {1, 9}, {13, 1}, {31, 17}}) {
    const auto values =
        random_values(2 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height), 500.0F, 3);
    write_flo(folder / "a.flo", {values.data(), nullptr, width, height});
    const FlowImage read = read_flo(folder / "a.flo");
    EXPECT_EQ(read.flow, values);
    EXPECT_EQ(read.width, width);
    EXPECT_EQ(read.height, height);
  }
}

TEST(Flo, UnknownFlowIsMarkedAndWritten) {
  const TempFolder folder;
  const std::vector<float> values = {1, 2, 1.67e9F, 0, 3, kNan, -1e9F, 4, 5, -2e9F};
  put(folder / "a.flo", make_flo(5, 1, values));
  const FlowImage read = read_flo(folder / "a.flo");
  EXPECT_EQ(read.valid, (std::vector<std::uint8_t>{1, 0, 0, 1, 0}));
  write_flo(folder / "b.flo", {read.flow.data(), read.valid.data(), 5, 1});
  EXPECT_EQ(get(folder / "b.flo"), make_flo(5, 1, {1, 2, 1e10F, 1e10F, 1e10F, 1e10F, -1e9F, 4, 1e10F, 1e10F}));
  AJNA_EXPECT_ERROR(write_flo(folder / "c.flo", {values.data(), nullptr, 5, 1}), ErrorKind::kInvalidArgument,
                    "at x 1, y 0");
  EXPECT_EQ(folder.entries(), 2U);
}

TEST(Flo, EveryTruncationAndLyingHeaderIsRefused) {
  const TempFolder folder;
  const Bytes whole = make_flo(2, 2, {1, 2, 3, 4, 5, 6, 7, 8});
  for (std::size_t length = 0; length < whole.size(); ++length) {
    put(folder / "cut.flo", Bytes(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(length)));
    AJNA_EXPECT_ERROR(read_flo(folder / "cut.flo"), ErrorKind::kInvalidArgument, "cut.flo");
  }
  Bytes longer = whole;
  longer.push_back(0);
  put(folder / "long.flo", longer);
  AJNA_EXPECT_ERROR(read_flo(folder / "long.flo"), ErrorKind::kInvalidArgument, "too long");
  put(folder / "magic.flo", make_flo(1, 1, {1, 2}, 202021.0F));
  AJNA_EXPECT_ERROR(read_flo(folder / "magic.flo"), ErrorKind::kInvalidArgument, "PIEH");
  constexpr std::int32_t kBig = std::numeric_limits<std::int32_t>::max();
  for (const auto& [width, height] : {std::pair{-1, 1},
                                      {1, -1},
                                      {-1, -1},
                                      {0, 4},
                                      {4, 0},
                                      {kBig, kBig},
                                      {kBig, 1},
                                      {std::numeric_limits<std::int32_t>::min(), 1},
                                      {65536, 65536},
                                      {3, 2},
                                      {1, 2}}) {
    put(folder / "lie.flo", make_flo(width, height, {1, 2, 3, 4, 5, 6, 7, 8}));
    AJNA_EXPECT_ERROR(read_flo(folder / "lie.flo"), ErrorKind::kInvalidArgument, std::to_string(width) + "x");
  }
  AJNA_EXPECT_ERROR(read_flo(folder / "no.flo"), ErrorKind::kFileNotFound, "no.flo");
  AJNA_EXPECT_ERROR(read_flo(folder.path()), ErrorKind::kInvalidArgument, "is a folder");
}

TEST(Kitti, ReadsAnIndependentFile) {
  const TempFolder folder;
  // (R, G, B): u = (0x8040 - 0x8000) / 64 = 1, v = (0x7FE0 - 0x8000) / 64 = -0.5; the second pixel is invalid.
  put(folder / "flow.png",
      make_png(2, 1, 16, 2, {{0x80, 0x40, 0x7F, 0xE0, 0x00, 0x01, 0x12, 0x34, 0x56, 0x78, 0x00, 0x00}}));
  const FlowImage read = read_kitti_flow(folder / "flow.png");
  EXPECT_EQ(read.flow, (std::vector<float>{1.0F, -0.5F, 0.0F, 0.0F}));
  EXPECT_EQ(read.valid, (std::vector<std::uint8_t>{1, 0}));
}

TEST(Kitti, RoundTripsToOneSixtyFourth) {
  const TempFolder folder;
  const auto values = random_values(2 * 11 * 7, 511.9F, 9);
  std::vector<std::uint8_t> valid(11 * 7);
  for (std::size_t i = 0; i < valid.size(); ++i) {
    valid[i] = i % 3 != 0 ? 1 : 0;
  }
  write_kitti_flow(folder / "a.png", {values.data(), valid.data(), 11, 7});
  const FlowImage read = read_kitti_flow(folder / "a.png");
  EXPECT_EQ(read.valid, valid);
  for (std::size_t i = 0; i < values.size(); ++i) {
    EXPECT_NEAR(read.flow[i], valid[i / 2] != 0 ? values[i] : 0.0F, 0.5 / 64 + 1e-6);
  }
  write_kitti_flow(folder / "b.png", {read.flow.data(), read.valid.data(), 11, 7});
  EXPECT_EQ(read_kitti_flow(folder / "b.png").flow, read.flow) << "not idempotent";
}

TEST(Kitti, RangeAndFormatAreChecked) {
  const TempFolder folder;
  const std::vector<float> limits = {-512.0F, 511.98F};
  ASSERT_NO_THROW(write_kitti_flow(folder / "a.png", {limits.data(), nullptr, 1, 1}));
  for (const float bad : {-512.1F, 512.0F, 1e10F, kNan, std::numeric_limits<float>::infinity()}) {
    const std::vector<float> values = {0.0F, bad};
    AJNA_EXPECT_ERROR(write_kitti_flow(folder / "b.png", {values.data(), nullptr, 1, 1}), ErrorKind::kInvalidArgument,
                      "-512 to 511.98");
    const std::uint8_t invalid = 0;
    EXPECT_NO_THROW(write_kitti_flow(folder / "a.png", {values.data(), &invalid, 1, 1}));
  }
  AJNA_EXPECT_ERROR(write_kitti_flow(folder / "a.tif", {limits.data(), nullptr, 1, 1}), ErrorKind::kInvalidArgument,
                    "use .png");
  put(folder / "eight.png", make_png(1, 1, 8, 2, {{1, 2, 3}}));
  AJNA_EXPECT_ERROR(read_kitti_flow(folder / "eight.png"), ErrorKind::kInvalidArgument, "3 channels of 8 bits");
  put(folder / "grey.png", make_png(1, 1, 16, 0, {{1, 2}}));
  AJNA_EXPECT_ERROR(read_kitti_flow(folder / "grey.png"), ErrorKind::kInvalidArgument, "1 channels of 16 bits");
  const Bytes whole = get(folder / "a.png");
  for (std::size_t length = 0; length < whole.size(); ++length) {
    put(folder / "cut.png", Bytes(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(length)));
    AJNA_EXPECT_ERROR(read_kitti_flow(folder / "cut.png"), ErrorKind::kInvalidArgument, "cut.png");
  }
}

Bytes make_pfm(const std::string& header, const std::vector<float>& values, bool big_endian) {
  Bytes bytes(header.begin(), header.end());
  for (float value : values) {
    Bytes four;
    append(four, value);
    bytes.insert(bytes.end(), big_endian ? four.rbegin() : Bytes::reverse_iterator(four.end()), four.rend());
    if (!big_endian) {
      std::reverse(bytes.end() - 4, bytes.end());
    }
  }
  return bytes;
}

TEST(Pfm, WritesByteExactBottomUp) {
  const TempFolder folder;
  const std::vector<float> top_down = {1, 2, 3, 4, 5, 6};  // two rows of three
  write_pfm(folder / "a.pfm", top_down.data(), 3, 2, 1);
  EXPECT_EQ(get(folder / "a.pfm"), make_pfm("Pf\n3 2\n-1.0\n", {4, 5, 6, 1, 2, 3}, false));
  write_pfm(folder / "b.pfm", top_down.data(), 1, 2, 3);
  EXPECT_EQ(get(folder / "b.pfm"), make_pfm("PF\n1 2\n-1.0\n", {4, 5, 6, 1, 2, 3}, false));
}

TEST(Pfm, TwoChannelsAreStoredAsThreeWithAZero) {
  const TempFolder folder;
  const std::vector<float> flow = {1, 2, 3, 4};
  write_pfm(folder / "a.pfm", flow.data(), 2, 1, 2);
  EXPECT_EQ(get(folder / "a.pfm"), make_pfm("PF\n2 1\n-1.0\n", {1, 2, 0, 3, 4, 0}, false));
  const FloatImage read = read_pfm(folder / "a.pfm");
  EXPECT_EQ(read.channels, 3);
  EXPECT_EQ(read.data, (std::vector<float>{1, 2, 0, 3, 4, 0}));
}

TEST(Pfm, ReadsBothByteOrdersAndLooseHeaders) {
  const TempFolder folder;
  for (const bool big : {false, true}) {
    const std::string sign = big ? "" : "-";
    for (const std::string& header :
         {"Pf\n2 2\n" + sign + "1\n", "Pf\r\n2 2\r" + sign + "0.003922 ", "Pf 2\n2\n" + sign + "1.000000e+00\n"}) {
      // A carriage return and a line feed are two separators: the header's last word takes only one.
      put(folder / "a.pfm", make_pfm(header, {3, 4, 1, 2}, big));
      const FloatImage read = read_pfm(folder / "a.pfm");
      EXPECT_EQ(read.data, (std::vector<float>{1, 2, 3, 4})) << header;
      EXPECT_EQ(read.channels, 1);
    }
  }
}

TEST(Pfm, RoundTripsWithNonFiniteValues) {
  const TempFolder folder;
  for (const int channels : {1, 3}) {
    auto values = random_values(std::size_t{20} * static_cast<std::size_t>(channels), 1e6F, 4);
    values[0] = kNan;
    values[1] = std::numeric_limits<float>::infinity();
    write_pfm(folder / "a.pfm", values.data(), 5, 4, channels);
    const FloatImage read = read_pfm(folder / "a.pfm");
    EXPECT_EQ(read.channels, channels);
    EXPECT_EQ(std::memcmp(read.data.data(), values.data(), sizeof(float) * values.size()), 0);
  }
}

TEST(Pfm, EveryTruncationAndLyingHeaderIsRefused) {
  const TempFolder folder;
  const Bytes whole = make_pfm("PF\n2 1\n-1.0\n", {1, 2, 3, 4, 5, 6}, false);
  for (std::size_t length = 0; length < whole.size(); ++length) {
    put(folder / "cut.pfm", Bytes(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(length)));
    AJNA_EXPECT_ERROR(read_pfm(folder / "cut.pfm"), ErrorKind::kInvalidArgument, "cut.pfm");
  }
  for (const std::string header :
       {"PF\n-2 1\n-1\n", "PF\n0 1\n-1\n", "PF\n2147483647 2147483647\n-1\n", "PF\n99999999999 1\n-1\n", "PF\n2 1\n0\n",
        "PF\n2 1\nnan\n", "PF\n2 1\n1,0\n", "PF\n2 1\n-inf\n", "PF\n2 x\n-1\n", "PF\n2 2\n-1\n", "PF\n1 1\n-1\n",
        "Pf\n2 1\n-1\n", "P6\n2 1\n-1\n", "PFx2 1\n-1\n"}) {
    put(folder / "lie.pfm", make_pfm(header, {1, 2, 3, 4, 5, 6}, false));
    AJNA_EXPECT_ERROR(read_pfm(folder / "lie.pfm"), ErrorKind::kInvalidArgument, "lie.pfm");
  }
  const float value = 0;
  AJNA_EXPECT_ERROR(write_pfm(folder / "a.pfm", &value, 1, 1, 4), ErrorKind::kInvalidArgument, "4 channels");
  AJNA_EXPECT_ERROR(write_pfm(folder / "a.pfm", &value, 0, 1, 1), ErrorKind::kInvalidArgument, "0x1");
}

}  // namespace
}  // namespace ajna::io
