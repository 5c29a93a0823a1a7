// SPDX-License-Identifier: MIT
#include "ajna/nn/safetensors.hpp"

#include <algorithm>
#include <array>
#include <filesystem>
#include <fstream>
#include <utility>
#include <vector>

#include "ajna/base/atomic_file.hpp"
#include "ajna/base/error.hpp"
#include "ajna/nn/safetensors_header.hpp"

namespace ajna::nn {
namespace {

namespace fs = std::filesystem;

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "safetensors data is little-endian and is read as it lies");

constexpr std::uint64_t kLengthBytes = 8;
constexpr std::uint64_t kMaxHeaderBytes = std::uint64_t{16} << 20;

struct Dtype {
  const char* name;
  torch::ScalarType type;
};
// BOOL is left out: a stored byte other than 0 and 1 would be an invalid C++ bool, and nothing here needs it.
constexpr std::array<Dtype, 9> kDtypes{{{"F64", torch::kFloat64},
                                        {"F32", torch::kFloat32},
                                        {"F16", torch::kFloat16},
                                        {"BF16", torch::kBFloat16},
                                        {"I64", torch::kInt64},
                                        {"I32", torch::kInt32},
                                        {"I16", torch::kInt16},
                                        {"I8", torch::kInt8},
                                        {"U8", torch::kUInt8}}};

std::uint64_t open_checked(const std::string& path, std::ifstream& stream) {
  std::error_code failure;
  const auto status = fs::status(path, failure);
  if (!fs::exists(status)) {
    throw_not_found(path, "give the path of a .safetensors file");
  }
  if (!fs::is_regular_file(status)) {
    throw_invalid("'" + path + "' is " + (fs::is_directory(status) ? "a folder" : "not a regular file") +
                  ": give a .safetensors file");
  }
  const std::uint64_t size = fs::file_size(path, failure);
  stream.open(path, std::ios::binary);
  if (failure || !stream) {
    throw_runtime("file '" + path + "' cannot be opened for reading: check its permissions");
  }
  return size;
}

/// Bytes of a tensor as its header describes it; every product is checked.
std::uint64_t expected_bytes(const TensorEntry& entry, torch::ScalarType type, const std::string& name) {
  std::uint64_t bytes = c10::elementSize(type);
  for (const std::int64_t side : entry.shape) {
    if (side == 0) {
      throw_invalid("tensor '" + name + "' is empty");
    }
    if (__builtin_mul_overflow(bytes, static_cast<std::uint64_t>(side), &bytes)) {
      throw_invalid("tensor '" + name + "' claims more elements than 64 bits can count");
    }
  }
  return bytes;
}

torch::ScalarType parse_dtype(const TensorEntry& entry, const std::string& name) {
  for (const auto& dtype : kDtypes) {
    if (entry.dtype == dtype.name) {
      return dtype.type;
    }
  }
  throw_invalid("tensor '" + name + "' has the unsupported dtype '" + entry.dtype.substr(0, 16) + "'");
}

/// The tensors must tile the data exactly: in this order, without gap or overlap, to its last byte.
void check_layout(const SafetensorsHeader& header, std::uint64_t data_bytes) {
  std::vector<std::pair<const std::string*, const TensorEntry*>> order;
  order.reserve(header.tensors.size());
  for (const auto& [name, entry] : header.tensors) {
    order.emplace_back(&name, &entry);
  }
  std::sort(order.begin(), order.end(), [](const auto& a, const auto& b) {
    return std::make_pair(a.second->begin, a.second->end) < std::make_pair(b.second->begin, b.second->end);
  });
  std::uint64_t cursor = 0;
  for (const auto& [name, entry] : order) {
    const std::string span =
        "tensor '" + *name + "' lies at bytes " + std::to_string(entry->begin) + " to " + std::to_string(entry->end);
    if (entry->begin > entry->end) {
      throw_invalid(span + ", which is backwards");
    }
    if (entry->end > data_bytes) {
      throw_invalid(span + " but the data end at " + std::to_string(data_bytes) + ": the file is truncated");
    }
    if (entry->begin != cursor) {
      throw_invalid(span + ", which leaves a gap or overlaps another tensor");
    }
    cursor = entry->end;
    const auto bytes = expected_bytes(*entry, parse_dtype(*entry, *name), *name);
    if (bytes != entry->end - entry->begin) {
      throw_invalid(span + " but its shape and dtype need " + std::to_string(bytes) + " bytes");
    }
  }
  if (cursor != data_bytes) {
    throw_invalid(std::to_string(data_bytes - cursor) + " bytes follow the last tensor");
  }
}

SafetensorsHeader read_header(std::ifstream& stream, std::uint64_t file_bytes, std::uint64_t& data_start) {
  if (file_bytes < kLengthBytes + 2) {
    throw_invalid(file_bytes == 0 ? "the file is empty"
                                  : "the file is only " + std::to_string(file_bytes) + " bytes long");
  }
  std::array<unsigned char, kLengthBytes> prefix{};
  stream.read(reinterpret_cast<char*>(prefix.data()), kLengthBytes);
  std::uint64_t header_bytes = 0;
  for (std::size_t i = kLengthBytes; i-- > 0;) {
    header_bytes = header_bytes << 8 | prefix[i];
  }
  if (prefix[0] == 'P' && prefix[1] == 'K' && prefix[2] == 3 && prefix[3] == 4) {
    throw_invalid("it is a zip archive, as torch.save and TorchScript write it");
  }
  if (header_bytes > kMaxHeaderBytes || header_bytes < 2) {
    throw_invalid("it does not begin with the length of a safetensors header");
  }
  if (header_bytes > file_bytes - kLengthBytes) {
    throw_invalid("its header needs " + std::to_string(header_bytes) + " bytes but only " +
                  std::to_string(file_bytes - kLengthBytes) + " follow: the file is truncated");
  }
  std::string text(header_bytes, '\0');
  if (!stream || !stream.read(text.data(), static_cast<std::streamsize>(header_bytes))) {
    throw_invalid("its header cannot be read");
  }
  data_start = kLengthBytes + header_bytes;
  return parse_safetensors_header(text);
}

}  // namespace

NamedTensors read_safetensors(const std::string& path) {
  std::ifstream stream;
  const std::uint64_t file_bytes = open_checked(path, stream);
  try {
    std::uint64_t data_start = 0;
    SafetensorsHeader header = read_header(stream, file_bytes, data_start);
    check_layout(header, file_bytes - data_start);
    NamedTensors content;
    content.metadata = std::move(header.metadata);
    for (const auto& [name, entry] : header.tensors) {
      auto tensor = torch::empty(entry.shape, torch::dtype(parse_dtype(entry, name)));
      stream.seekg(static_cast<std::streamoff>(data_start + entry.begin));
      const auto bytes = static_cast<std::streamsize>(entry.end - entry.begin);
      if (bytes > 0 && !stream.read(static_cast<char*>(tensor.mutable_data_ptr()), bytes)) {
        throw_invalid("tensor '" + name + "' cannot be read: the file changed or is truncated");
      }
      content.tensors.emplace(name, std::move(tensor));
    }
    return content;
  } catch (const Error& error) {
    throw_invalid("'" + path + "' is not a usable safetensors file: " + error.what());
  }
}

void write_safetensors(const std::string& path, const NamedTensors& content) {
  SafetensorsHeader header;
  header.metadata = content.metadata;
  std::vector<torch::Tensor> order;
  std::uint64_t offset = 0;
  // Wide elements first, so that every tensor is aligned to its element, as other readers expect.
  for (const std::size_t width : {8U, 4U, 2U, 1U}) {
    for (const auto& [name, tensor] : content.tensors) {
      const auto type = tensor.scalar_type();
      if (c10::elementSize(type) != width) {
        continue;
      }
      const auto* known = std::find_if(kDtypes.begin(), kDtypes.end(), [&](const Dtype& d) { return d.type == type; });
      if (known == kDtypes.end()) {
        throw_invalid("tensor '" + name + "' of dtype " + c10::toString(type) + " cannot be stored");
      }
      order.push_back(tensor.detach().to(torch::kCPU).contiguous());
      const std::uint64_t bytes = order.back().nbytes();
      header.tensors[name] = {known->name, tensor.sizes().vec(), offset, offset + bytes};
      offset += bytes;
    }
  }
  if (header.tensors.size() != content.tensors.size()) {
    throw_invalid("a tensor's dtype cannot be stored: give plain real, integer or bool tensors");
  }
  std::string text = format_safetensors_header(header);
  text.append((kLengthBytes - text.size() % kLengthBytes) % kLengthBytes, ' ');
  if (text.size() > kMaxHeaderBytes) {
    throw_invalid("metadata and names take " + std::to_string(text.size()) + " bytes: shorten the metadata");
  }
  write_atomically(path, [&](const std::string& temporary) {
    std::ofstream stream(temporary, std::ios::binary);
    std::array<char, kLengthBytes> prefix{};
    for (std::size_t i = 0; i < kLengthBytes; ++i) {
      prefix[i] = static_cast<char>(text.size() >> (8 * i) & 0xFF);
    }
    stream.write(prefix.data(), kLengthBytes);
    stream.write(text.data(), static_cast<std::streamsize>(text.size()));
    for (const auto& tensor : order) {
      stream.write(static_cast<const char*>(tensor.const_data_ptr()), static_cast<std::streamsize>(tensor.nbytes()));
    }
    stream.close();
    if (!stream) {
      throw_runtime("file '" + path + "' cannot be written: check free space and permissions");
    }
  });
}

}  // namespace ajna::nn
