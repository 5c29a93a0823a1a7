// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <atomic>
#include <filesystem>
#include <fstream>
#include <string>

#include "ajna/base/error.hpp"
#include "ajna/nn/checkpoint.hpp"

namespace ajna::testing {

/// A folder of its own, removed at the end of the test.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    static std::atomic<int> counter{0};
    path_ = std::filesystem::temp_directory_path() /
            ("ajna-test-" + std::to_string(::getpid()) + "-" + std::to_string(counter++));
    std::filesystem::create_directories(path_);
  }
  ~TemporaryFolder() { std::filesystem::remove_all(path_); }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  [[nodiscard]] std::string file(const std::string& name) const { return (path_ / name).string(); }
  [[nodiscard]] std::size_t count() const {
    return static_cast<std::size_t>(std::distance(std::filesystem::directory_iterator(path_), {}));
  }

 private:
  std::filesystem::path path_;
};

inline std::string read_bytes(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

inline void write_bytes(const std::string& path, const std::string& bytes) {
  std::ofstream(path, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

/// softplus and its square: the paper's loss, coarsely.
inline nn::UncertaintyTable paper_table() {
  nn::UncertaintyTable table{-16.0, 1.0 / 16.0, {}, {}};
  const auto raw = torch::arange(0, 1281, torch::kFloat64).mul(table.raw_step).add(table.raw_min);
  table.uncertainty = torch::softplus(raw).to(torch::kFloat32);
  table.expected_error = torch::softplus(raw).square().to(torch::kFloat32);
  return table;
}

/// A small network whose normalization is not trivial, so that folding and modes show.
inline nn::FlowNet small_net(nn::NetConfig config = {6, 4, 8, 2, 1}) {
  torch::manual_seed(7);
  nn::FlowNet net(config);
  const torch::NoGradGuard no_grad;
  for (const auto& buffer : net->named_buffers()) {
    auto tensor = buffer.value();
    if (tensor.is_floating_point()) {
      tensor.copy_(torch::rand_like(tensor) + 0.3);
    }
  }
  for (const auto& parameter : net->named_parameters()) {
    if (parameter.key().find("norm") != std::string::npos) {
      auto tensor = parameter.value();
      tensor.copy_(torch::rand_like(tensor) + 0.4);
    }
  }
  net->eval();
  return net;
}

inline nn::Metadata small_metadata(const nn::FlowNetImpl& net) {
  nn::Metadata metadata;
  metadata.name = "ajna-test";
  metadata.net = net.config();
  metadata.flow_scale = 2.5;
  metadata.loss = "f=l1";
  metadata.table = paper_table();
  metadata.provenance = {{"steps", "3"}, {"note", "quotes \" and \\, line\nbreak, \xC3\xA9"}};
  return metadata;
}

/// Runs `action` and expects an Error of `kind` whose text has no line break and names `part`.
template <typename Action>
void expect_error(ErrorKind kind, const std::string& part, const Action& action) {
  try {
    action();
    ADD_FAILURE() << "nothing was thrown; expected: " << part;
  } catch (const Error& error) {
    const std::string text = error.what();
    EXPECT_EQ(error.kind(), kind) << text;
    EXPECT_NE(text.find(part), std::string::npos) << text;
    EXPECT_EQ(text.find('\n'), std::string::npos) << text;
  }
}

}  // namespace ajna::testing
