// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <random>

#include "ajna/nn/checkpoint.hpp"
#include "ajna/nn/safetensors.hpp"
#include "ajna/nn/safetensors_header.hpp"
#include "nn_fixtures.hpp"

namespace ajna::nn {
namespace {

using namespace ajna::testing;

/// A safetensors file with this header text and so many zero bytes of data.
std::string file_of(const std::string& header, std::size_t data_bytes) {
  std::string bytes(8, '\0');
  for (std::size_t i = 0; i < 8; ++i) {
    bytes[i] = static_cast<char>(header.size() >> (8 * i) & 0xFF);
  }
  return bytes + header + std::string(data_bytes, '\0');
}

class CheckpointTest : public ::testing::Test {
 protected:
  void SetUp() override {
    net_ = small_net();
    metadata_ = small_metadata(*net_);
    path_ = folder_.file("model.safetensors");
  }
  void save() { save_checkpoint(path_, *net_, metadata_); }
  /// Saves, lets `change` edit the stored content, and expects loading to fail with `part`.
  void expect_refused(const std::string& part, const std::function<void(NamedTensors&)>& change) {
    save();
    NamedTensors content = read_safetensors(path_);
    change(content);
    write_safetensors(path_, content);
    expect_error(ErrorKind::kInvalidArgument, part, [&] { load_checkpoint(path_); });
  }

  TemporaryFolder folder_;
  FlowNet net_{nullptr};
  Metadata metadata_;
  std::string path_;
};

TEST_F(CheckpointTest, RoundTripKeepsEveryBit) {
  net_->train();
  save();
  EXPECT_TRUE(net_->is_training()) << "saving must not change the network";
  const auto random_before = at::detail::getDefaultCPUGenerator().get_state();
  const Checkpoint loaded = load_checkpoint(path_);
  EXPECT_TRUE(random_before.equal(at::detail::getDefaultCPUGenerator().get_state()));
  EXPECT_FALSE(loaded.net->is_training());
  const auto parameters = loaded.net->named_parameters();
  for (const auto& item : net_->named_parameters()) {
    EXPECT_TRUE(parameters[item.key()].equal(item.value())) << item.key();
    EXPECT_TRUE(parameters[item.key()].requires_grad());
  }
  const auto buffers = loaded.net->named_buffers();
  for (const auto& item : net_->named_buffers()) {
    EXPECT_TRUE(buffers[item.key()].equal(item.value())) << item.key();
  }
  EXPECT_EQ(loaded.metadata.name, metadata_.name);
  EXPECT_TRUE(loaded.metadata.net == metadata_.net);
  EXPECT_EQ(loaded.metadata.flow_scale, metadata_.flow_scale);
  EXPECT_EQ(loaded.metadata.loss, metadata_.loss);
  EXPECT_EQ(loaded.metadata.provenance, metadata_.provenance);
  EXPECT_EQ(loaded.metadata.table.raw_min, metadata_.table.raw_min);
  EXPECT_EQ(loaded.metadata.table.raw_step, metadata_.table.raw_step);
  EXPECT_TRUE(loaded.metadata.table.uncertainty.equal(metadata_.table.uncertainty));
  EXPECT_TRUE(loaded.metadata.table.expected_error.equal(metadata_.table.expected_error));
  EXPECT_EQ(folder_.count(), 1U) << "a temporary file was left";
}

TEST_F(CheckpointTest, EqualContentGivesEqualBytes) {
  save();
  const std::string first = read_bytes(path_);
  save();
  EXPECT_EQ(read_bytes(path_), first);
}

TEST_F(CheckpointTest, NumbersSurviveAsTheyAre) {
  for (const double scale : {1.0 / 3.0, 1e-300, 20.0, 123456789.123456789}) {
    metadata_.flow_scale = scale;
    EXPECT_EQ(metadata_from_strings(metadata_to_strings(metadata_)).flow_scale, scale);
  }
}

TEST_F(CheckpointTest, ParameterCountOfAConfigMatchesTheBuiltNetwork) {
  for (const NetConfig& config :
       {NetConfig{}, NetConfig{1, 1, 32, 2, 2}, NetConfig{6, 4, 8, 1, 0}, NetConfig{3, 2, 4, 3, 3}}) {
    EXPECT_EQ(count_parameters(config), count_parameters(*FlowNet(config)));
  }
  EXPECT_EQ(count_parameters(NetConfig{}), 2724980);
}

TEST_F(CheckpointTest, SavingRefusesWhatLoadingWould) {
  const auto refused = [&](const std::string& part, const std::function<void()>& change) {
    net_ = small_net();
    metadata_ = small_metadata(*net_);
    change();
    expect_error(ErrorKind::kInvalidArgument, part, [&] { save(); });
    EXPECT_EQ(folder_.count(), 0U);
  };
  refused("name is empty", [&] { metadata_.name = ""; });
  refused("flow_scale", [&] { metadata_.flow_scale = 0; });
  refused("flow_scale", [&] { metadata_.flow_scale = std::nan(""); });
  refused("another network", [&] { metadata_.net.width = 16; });
  refused("steps of 0", [&] { metadata_.table.raw_step = 0; });
  refused("NaN", [&] {
    const torch::NoGradGuard no_grad;
    net_->parameters()[0].fill_(std::nan(""));
  });
  refused("float32", [&] { net_->to(torch::kFloat64); });
  refused(".safetensors", [&] { path_ = folder_.file("model.pt"); });
}

TEST_F(CheckpointTest, UnusableOutputPlaces) {
  path_ = folder_.file("missing/model.safetensors");
  expect_error(ErrorKind::kFileNotFound, "missing", [&] { save(); });
  path_ = folder_.file("folder.safetensors");
  std::filesystem::create_directory(path_);
  expect_error(ErrorKind::kInvalidArgument, "is a folder", [&] { save(); });
  path_ = folder_.file("plain");
  write_bytes(path_, "a file");
  path_ += "/model.safetensors";
  expect_error(ErrorKind::kInvalidArgument, "not a folder", [&] { save(); });
  if (std::filesystem::is_directory("/proc")) {
    path_ = "/proc/model.safetensors";  // refuses even the superuser
    expect_error(ErrorKind::kRuntime, "not writable", [&] { save(); });
  }
}

TEST_F(CheckpointTest, RefusesContentThatDoesNotFit) {
  expect_refused("is missing", [](auto& c) { c.tensors.erase("encoder.0.conv.weight"); });
  expect_refused("'table.uncertainty' is missing", [](auto& c) { c.tensors.erase("table.uncertainty"); });
  expect_refused("'extra' does not belong", [](auto& c) { c.tensors["extra"] = torch::zeros({3}); });
  expect_refused("but the network has", [](auto& c) { c.tensors["encoder.0.conv.bias"] = torch::zeros({4, 2}); });
  expect_refused("Double", [](auto& c) {
    auto& t = c.tensors["encoder.0.conv.bias"];
    t = t.to(torch::kFloat64);
  });
  expect_refused("NaN", [](auto& c) { c.tensors["encoder.0.conv.bias"].fill_(std::nan("")); });
  expect_refused("must be finite", [](auto& c) { c.tensors["table.expected_error"].fill_(INFINITY); });
  expect_refused("no Ajna metadata", [](auto& c) { c.metadata.clear(); });
  expect_refused("version '2'", [](auto& c) { c.metadata["version"] = "2"; });
  expect_refused("no 'net.width'", [](auto& c) { c.metadata.erase("net.width"); });
  expect_refused("not a number", [](auto& c) { c.metadata["flow_scale"] = "2.5px"; });
  expect_refused("not a number", [](auto& c) { c.metadata["net.width"] = "99999999999999999999"; });
  expect_refused("flow_scale", [](auto& c) { c.metadata["flow_scale"] = "-1"; });
  expect_refused("steps of nan", [](auto& c) { c.metadata["table.raw_step"] = "nan"; });
  expect_refused("'colour' is unknown", [](auto& c) { c.metadata["colour"] = "red"; });
}

TEST_F(CheckpointTest, AClaimedGiantIsRefusedBeforeItIsBuilt) {
  expect_refused("parameters but the file holds", [](auto& c) {
    c.metadata["net.width"] = "1024";
    c.metadata["net.expansion"] = "4";
    c.metadata["net.sub_blocks"] = "4";
  });
  expect_refused("in_channels", [](auto& c) { c.metadata["net.in_channels"] = "4611686018427387904"; });
  expect_refused("width", [](auto& c) { c.metadata["net.width"] = "-8"; });
}

TEST_F(CheckpointTest, RefusesForeignFiles) {
  const auto refused = [&](const std::string& part, const std::string& bytes) {
    write_bytes(path_, bytes);
    expect_error(ErrorKind::kInvalidArgument, part, [&] { load_checkpoint(path_); });
  };
  expect_error(ErrorKind::kFileNotFound, "does not exist", [&] { load_checkpoint(path_); });
  expect_error(ErrorKind::kInvalidArgument, "is a folder",
               [&] { load_checkpoint(std::filesystem::temp_directory_path().string()); });
  expect_error(ErrorKind::kInvalidArgument, "not a regular file", [] { load_checkpoint("/dev/zero"); });
  refused("is empty", "");
  refused("5 bytes", "hello");
  refused("zip archive", std::string("PK\x03\x04") + std::string(100, 'x'));
  refused("does not begin", std::string("\x89PNG\r\n\x1a\n") + std::string(100, 'x'));
  refused("truncated", file_of("{}        ", 0).substr(0, 12));
  refused("byte 0", file_of("hello world", 4));
}

TEST_F(CheckpointTest, RefusesLyingHeaders) {
  const auto refused = [&](const std::string& part, const std::string& header, std::size_t data_bytes) {
    write_bytes(path_, file_of(header, data_bytes));
    expect_error(ErrorKind::kInvalidArgument, part, [&] { read_safetensors(path_); });
  };
  const auto entry = [](const std::string& shape, const std::string& offsets, const std::string& dtype = "F32") {
    return R"({"dtype":")" + dtype + R"(","shape":[)" + shape + R"(],"data_offsets":[)" + offsets + "]}";
  };
  refused("the data end at 4", R"({"a":)" + entry("2", "0,8") + "}", 4);
  refused("the data end at 4", R"({"a":)" + entry("1000000000000", "0,4000000000000") + "}", 4);
  refused("backwards", R"({"a":)" + entry("1", "4,0") + "}", 4);
  refused("need 8 bytes", R"({"a":)" + entry("2", "0,4") + "}", 4);
  refused("64 bits", R"({"a":)" + entry("4611686018427387904,4611686018427387904", "0,4") + "}", 4);
  refused("is empty", R"({"a":)" + entry("0,4", "0,0") + "}", 0);
  refused("overlaps", R"({"a":)" + entry("1", "0,4") + R"(,"b":)" + entry("1", "0,4") + "}", 8);
  refused("gap", R"({"a":)" + entry("1", "0,4") + R"(,"b":)" + entry("1", "8,12") + "}", 12);
  refused("4 bytes follow", R"({"a":)" + entry("1", "0,4") + "}", 8);
  refused("unsupported dtype 'X9'", R"({"a":)" + entry("1", "0,4", "X9") + "}", 4);
  refused("duplicate tensor name", R"({"a":)" + entry("1", "0,4") + R"(,"a":)" + entry("1", "0,4") + "}", 4);
  refused("duplicate key", R"({"__metadata__":{"k":"1","k":"2"}})", 0);
  refused("duplicate key", R"({"__metadata__":{},"__metadata__":{}})", 0);
  refused("duplicate field", R"({"a":{"dtype":"F32","dtype":"F32"}})", 0);
  refused("unknown field", R"({"a":{"colour":"red"}})", 0);
  refused("without dtype", R"({"a":{"dtype":"F32"}})", 0);
  refused("two numbers", R"({"a":)" + entry("1", "0") + "}", 4);
  refused("more than 8", R"({"a":)" + entry("1,1,1,1,1,1,1,1,1", "0,4") + "}", 4);
  refused("number too large", R"({"a":)" + entry("9223372036854775808", "0,4") + "}", 4);
  refused("integer", R"({"a":)" + entry("-1", "0,4") + "}", 4);
  refused("leading zeros", R"({"a":)" + entry("01", "0,4") + "}", 4);
  refused("expected '\"'", R"({"__metadata__":{"k":1}})", 0);
  refused("text after the end", "{} {}", 0);
  refused("without an end", R"({"a)", 0);
  refused("lone surrogate", R"({"\ud800":1})", 0);
  refused("not UTF-8", "{\"\xff\":1}", 0);
  refused("not UTF-8", "{\"\xc0\xaf\":1}", 0);
  refused("control character", "{\"a\nb\":1}", 0);
}

TEST_F(CheckpointTest, EveryTruncationIsRefused) {
  save();
  const std::string bytes = read_bytes(path_);
  for (std::size_t size = 0; size < bytes.size(); size += 1 + size / 3) {
    write_bytes(path_, bytes.substr(0, size));
    EXPECT_THROW(load_checkpoint(path_), Error) << size;
  }
  write_bytes(path_, bytes.substr(0, bytes.size() - 1));
  EXPECT_THROW(load_checkpoint(path_), Error);
  write_bytes(path_, bytes + "x");
  EXPECT_THROW(load_checkpoint(path_), Error);
}

TEST_F(CheckpointTest, RandomDamageToTheHeaderNeverCrashes) {
  save();
  const std::string bytes = read_bytes(path_);
  const std::size_t header_end = std::min<std::size_t>(bytes.size(), 4000);
  std::mt19937 random(1);
  int refused = 0;
  for (int trial = 0; trial < 400; ++trial) {
    std::string damaged = bytes;
    for (unsigned k = random() % 4 + 1; k > 0; --k) {
      damaged[random() % header_end] = static_cast<char>(random() & 0xFF);
    }
    write_bytes(path_, damaged);
    try {
      load_checkpoint(path_);  // a change within a free text is no damage
    } catch (const Error&) {
      ++refused;
    }
  }
  EXPECT_GT(refused, 300);
}

TEST(SafetensorsHeader, ReadsWhatItWrites) {
  SafetensorsHeader header;
  header.tensors["a \"b\" \\ \xE2\x82\xAC"] = {"F32", {2, 3}, 0, 24};
  header.tensors["scalar"] = {"I64", {}, 24, 32};
  header.metadata = {{"", "empty key"}, {"control", std::string("\x01\t\n")}};
  const auto again = parse_safetensors_header(format_safetensors_header(header));
  EXPECT_EQ(again.metadata, header.metadata);
  ASSERT_EQ(again.tensors.size(), 2U);
  for (const auto& [name, entry] : header.tensors) {
    const auto& other = again.tensors.at(name);
    EXPECT_EQ(other.dtype, entry.dtype);
    EXPECT_EQ(other.shape, entry.shape);
    EXPECT_EQ(other.begin, entry.begin);
    EXPECT_EQ(other.end, entry.end);
  }
  EXPECT_EQ(parse_string_map(format_string_map(header.metadata)), header.metadata);
  EXPECT_EQ(parse_string_map(R"( { "\u20ac\ud83d\ude00\/" : "x" } )").begin()->first, "\xE2\x82\xAC\xF0\x9F\x98\x80/");
}

TEST(SafetensorsHeader, RandomTextNeverCrashes) {
  std::mt19937 random(2);
  const std::string alphabet = R"({}[]:,"\u0d8 __metadata__dtypeshapedata_offsets)";
  for (int trial = 0; trial < 20000; ++trial) {
    std::string text = trial % 2 == 0 ? "{\"" : "";
    for (unsigned k = random() % 40; k > 0; --k) {
      text.push_back(alphabet[random() % alphabet.size()]);
    }
    try {
      parse_safetensors_header(text);
    } catch (const Error&) {
    }
  }
}

}  // namespace
}  // namespace ajna::nn
