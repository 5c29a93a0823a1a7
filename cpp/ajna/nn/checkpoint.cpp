// SPDX-License-Identifier: MIT
#include "ajna/nn/checkpoint.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/nn/random_state_guard.hpp"
#include "ajna/nn/safetensors.hpp"

namespace ajna::nn {
namespace {

constexpr const char* kFormat = "ajna-checkpoint";
constexpr const char* kVersion = "1";
constexpr const char* kUncertaintyName = "table.uncertainty";
constexpr const char* kExpectedErrorName = "table.expected_error";
constexpr const char* kProvenance = "provenance.";
constexpr const char* kCalibration = "calibration.";
constexpr const char* kCalibrationVersion = "1";
constexpr std::int64_t kMaxChannels = 4096;

using Strings = std::map<std::string, std::string>;

constexpr std::array<std::pair<const char*, std::int64_t NetConfig::*>, 5> kNetOptions{
    {{"net.in_channels", &NetConfig::in_channels},
     {"net.out_channels", &NetConfig::out_channels},
     {"net.width", &NetConfig::width},
     {"net.expansion", &NetConfig::expansion},
     {"net.sub_blocks", &NetConfig::sub_blocks}}};
/// Written only where they are not 0, so that files of the plain network stay as they were.
constexpr std::array<std::pair<const char*, std::int64_t NetConfig::*>, 3> kNetExtras{
    {{"net.skip_connections", &NetConfig::skip_connections},
     {"net.scale_heads", &NetConfig::scale_heads},
     {"net.correlation_radius", &NetConfig::correlation_radius}}};

constexpr std::array<const char*, 2> kFactors{"calibration.factors_u", "calibration.factors_v"};

std::string number_text(double value) {
  std::array<char, 32> text{};
  // The shortest text that reads back as the same bits, whatever the locale.
  const auto end = std::to_chars(text.data(), text.data() + text.size(), value).ptr;
  return {text.data(), end};
}

/// Removes and returns strings[key]; what is left at the end is surplus.
std::string take(Strings& strings, const std::string& key) {
  const auto found = strings.find(key);
  if (found == strings.end()) {
    throw_invalid("metadata has no '" + key + "'");
  }
  std::string value = std::move(found->second);
  strings.erase(found);
  return value;
}

template <typename Number>
Number to_number(const std::string& text, const std::string& key) {
  Number value{};
  const auto [end, failure] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (failure != std::errc() || end != text.data() + text.size()) {
    throw_invalid("metadata '" + key + "' is '" + text.substr(0, 40) + "', not a number");
  }
  return value;
}

template <typename Number>
Number take_number(Strings& strings, const std::string& key) {
  return to_number<Number>(take(strings, key), key);
}

/// Numbers with one space between them.
std::vector<double> take_numbers(Strings& strings, const std::string& key) {
  const std::string text = take(strings, key);
  std::vector<double> numbers;
  for (std::size_t begin = 0; begin <= text.size();) {
    const std::size_t end = std::min(text.find(' ', begin), text.size());
    numbers.push_back(to_number<double>(text.substr(begin, end - begin), key));
    begin = end + 1;
  }
  return numbers;
}

std::string numbers_text(const std::vector<double>& numbers) {
  std::string text;
  for (const double number : numbers) {
    if (!text.empty()) {
      text += ' ';
    }
    text += number_text(number);
  }
  return text;
}

/// Moves what `strings` holds under `prefix`, which is left out, to the result.
Strings take_group(Strings& strings, const std::string& prefix) {
  Strings group;
  for (auto item = strings.lower_bound(prefix);
       item != strings.end() && item->first.compare(0, prefix.size(), prefix) == 0;) {
    group.emplace(item->first.substr(prefix.size()), std::move(item->second));
    item = strings.erase(item);
  }
  return group;
}

void put_calibration(const Calibration& calibration, Strings& strings) {
  const std::string prefix = kCalibration;
  strings[prefix + "version"] = kCalibrationVersion;
  strings[prefix + "levels"] = numbers_text(calibration.factors.levels);
  for (std::size_t axis = 0; axis < kFactors.size(); ++axis) {
    std::vector<double> factors;
    factors.reserve(calibration.factors.factors.size());
    for (const auto& pair : calibration.factors.factors) {
      factors.push_back(pair[axis]);
    }
    strings[kFactors[axis]] = numbers_text(factors);
  }
  for (const auto& [key, value] : calibration.provenance) {
    strings[prefix + kProvenance + key] = value;
  }
}

/// Nothing where no key speaks of calibration. Leaves unknown keys behind.
std::optional<Calibration> take_calibration(Strings& strings) {
  const std::string prefix = kCalibration;
  const auto first = strings.lower_bound(prefix);
  if (first == strings.end() || first->first.compare(0, prefix.size(), prefix) != 0) {
    return std::nullopt;
  }
  if (const std::string version = take(strings, prefix + "version"); version != kCalibrationVersion) {
    throw_invalid("its calibration has version '" + version.substr(0, 40) + "' but this program reads version '" +
                  kCalibrationVersion + "': update ajna or calibrate the model again");
  }
  Calibration calibration;
  calibration.factors.levels = take_numbers(strings, prefix + "levels");
  calibration.factors.factors.resize(calibration.factors.levels.size());
  for (std::size_t axis = 0; axis < kFactors.size(); ++axis) {
    const auto factors = take_numbers(strings, kFactors[axis]);
    if (factors.size() != calibration.factors.levels.size()) {
      throw_invalid("metadata '" + std::string(kFactors[axis]) + "' has " + std::to_string(factors.size()) +
                    " numbers for " + std::to_string(calibration.factors.levels.size()) + " levels");
    }
    for (std::size_t i = 0; i < factors.size(); ++i) {
      calibration.factors.factors[i][axis] = factors[i];
    }
  }
  calibration.provenance = take_group(strings, prefix + kProvenance);
  calibration.check();
  return calibration;
}

void check_scalars(const Metadata& metadata) {
  if (metadata.name.empty()) {
    throw_invalid("model name is empty: give one, for example 'ajna-best'");
  }
  if (!std::isfinite(metadata.flow_scale) || metadata.flow_scale <= 0) {
    throw_invalid("flow_scale is " + number_text(metadata.flow_scale) + ": give a finite number above 0");
  }
  // FlowNet itself sets no upper limit; here one keeps the counting of parameters within 64 bits.
  for (const std::int64_t channels : {metadata.net.in_channels, metadata.net.out_channels}) {
    if (channels < 1 || channels > kMaxChannels) {
      throw_invalid("network option in_channels or out_channels is " + std::to_string(channels) + ": give 1 to " +
                    std::to_string(kMaxChannels));
    }
  }
}

void check_finite(const torch::Tensor& tensor, const std::string& name) {
  if (tensor.is_floating_point() && !tensor.isfinite().all().item<bool>()) {
    throw_invalid("tensor '" + name + "' holds NaN or infinite values: the training diverged, or the file is damaged");
  }
}

/// Move tensors[name] into `target`, strictly.
void fill(const torch::Tensor& target, const std::string& name, std::map<std::string, torch::Tensor>& tensors) {
  const auto found = tensors.find(name);
  if (found == tensors.end()) {
    throw_invalid("tensor '" + name + "' is missing");
  }
  const auto& source = found->second;
  if (source.sizes() != target.sizes() || source.scalar_type() != target.scalar_type()) {
    throw_invalid("tensor '" + name + "' is " + c10::str(source.sizes(), " ", c10::toString(source.scalar_type())) +
                  " but the network has " + c10::str(target.sizes(), " ", c10::toString(target.scalar_type())));
  }
  check_finite(source, name);
  target.copy_(source);
  tensors.erase(found);
}

torch::Tensor take_curve(std::map<std::string, torch::Tensor>& tensors, const std::string& name) {
  const auto found = tensors.find(name);
  if (found == tensors.end()) {
    throw_invalid("tensor '" + name + "' is missing");
  }
  auto curve = found->second;
  tensors.erase(found);
  return curve;
}

FlowNet build_network(const NetConfig& config, std::map<std::string, torch::Tensor>& tensors) {
  // Compare before building: a small file must not make us allocate the large network that its header claims. The
  // margin lets a file that merely lacks a tensor reach the message that names it.
  std::int64_t stored = 0;
  for (const auto& item : tensors) {
    stored += item.second.numel();
  }
  if (const std::int64_t needed = count_parameters(config); needed / 4 > stored) {
    throw_invalid("its metadata describe a network of " + std::to_string(needed) + " parameters but the file holds " +
                  std::to_string(stored));
  }
  const RandomStateGuard random_state;
  const torch::NoGradGuard no_grad;
  FlowNet net(config);
  for (const auto& parameter : net->named_parameters()) {
    fill(parameter.value(), parameter.key(), tensors);
  }
  for (const auto& buffer : net->named_buffers()) {
    fill(buffer.value(), buffer.key(), tensors);
  }
  if (!tensors.empty()) {
    throw_invalid("tensor '" + tensors.begin()->first + "' does not belong to the network");
  }
  net->eval();
  return net;
}

}  // namespace

std::map<std::string, std::string> metadata_to_strings(const Metadata& metadata) {
  check_scalars(metadata);
  Strings strings{{"format", kFormat},
                  {"version", kVersion},
                  {"name", metadata.name},
                  {"loss", metadata.loss},
                  {"flow_scale", number_text(metadata.flow_scale)},
                  {"table.raw_min", number_text(metadata.table.raw_min)},
                  {"table.raw_step", number_text(metadata.table.raw_step)}};
  for (const auto& [key, option] : kNetOptions) {
    strings[key] = std::to_string(metadata.net.*option);
  }
  for (const auto& [key, option] : kNetExtras) {
    if (metadata.net.*option != 0) {
      strings[key] = std::to_string(metadata.net.*option);
    }
  }
  for (const auto& [key, value] : metadata.provenance) {
    strings[kProvenance + key] = value;
  }
  if (metadata.calibration) {
    metadata.calibration->check();
    put_calibration(*metadata.calibration, strings);
  }
  return strings;
}

Metadata metadata_from_strings(const std::map<std::string, std::string>& strings) {
  Strings rest = strings;
  if (const auto format = rest.find("format"); format == rest.end() || format->second != kFormat) {
    throw_invalid("it carries no Ajna metadata (\"format\" is not \"" + std::string(kFormat) + "\")");
  }
  rest.erase("format");
  if (const std::string version = take(rest, "version"); version != kVersion) {
    throw_invalid("it has version '" + version.substr(0, 40) + "' but this program reads version '" + kVersion +
                  "': update ajna or convert the file");
  }
  Metadata metadata;
  metadata.name = take(rest, "name");
  metadata.loss = take(rest, "loss");
  metadata.flow_scale = take_number<double>(rest, "flow_scale");
  metadata.table.raw_min = take_number<double>(rest, "table.raw_min");
  metadata.table.raw_step = take_number<double>(rest, "table.raw_step");
  for (const auto& [key, option] : kNetOptions) {
    metadata.net.*option = take_number<std::int64_t>(rest, key);
  }
  for (const auto& [key, option] : kNetExtras) {
    if (rest.count(key) != 0) {
      metadata.net.*option = take_number<std::int64_t>(rest, key);
    }
  }
  metadata.provenance = take_group(rest, kProvenance);
  metadata.calibration = take_calibration(rest);
  if (!rest.empty()) {
    throw_invalid("metadata '" + rest.begin()->first.substr(0, 40) + "' is unknown to version " + kVersion);
  }
  check_scalars(metadata);
  return metadata;
}

void save_checkpoint(const std::string& path, const FlowNetImpl& net, const Metadata& metadata) {
  if (std::filesystem::path(path).extension() != ".safetensors") {
    throw_invalid("checkpoint name '" + path + "': give a name that ends in .safetensors");
  }
  if (!(metadata.net == net.config())) {
    throw_invalid("metadata of model '" + metadata.name +
                  "' describe another network: set metadata.net to net.config()");
  }
  metadata.table.check();
  NamedTensors content;
  content.metadata = metadata_to_strings(metadata);
  const auto add = [&](const auto& items) {
    for (const auto& item : items) {
      if (item.value().is_floating_point() && item.value().scalar_type() != torch::kFloat32) {
        throw_invalid("tensor '" + item.key() + "' is " + c10::toString(item.value().scalar_type()) +
                      ": a checkpoint holds float32; convert the network first");
      }
      check_finite(item.value(), item.key());
      content.tensors.emplace(item.key(), item.value());
    }
  };
  add(net.named_parameters());
  add(net.named_buffers());
  content.tensors.emplace(kUncertaintyName, metadata.table.uncertainty);
  content.tensors.emplace(kExpectedErrorName, metadata.table.expected_error);
  write_safetensors(path, content);
}

Checkpoint load_checkpoint(const std::string& path) {
  NamedTensors content = read_safetensors(path);
  try {
    Checkpoint checkpoint;
    checkpoint.metadata = metadata_from_strings(content.metadata);
    checkpoint.metadata.table.uncertainty = take_curve(content.tensors, kUncertaintyName);
    checkpoint.metadata.table.expected_error = take_curve(content.tensors, kExpectedErrorName);
    checkpoint.metadata.table.check();
    checkpoint.net = build_network(checkpoint.metadata.net, content.tensors);
    return checkpoint;
  } catch (const Error& error) {
    throw_invalid("'" + path + "' is not a usable Ajna checkpoint: " + error.what());
  }
}

}  // namespace ajna::nn
