// SPDX-License-Identifier: MIT
#include "apps/yaml_section.hpp"

#include <cmath>
#include <cstdlib>
#include <limits>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::apps {

YamlSection YamlSection::parse(const std::string& text, const std::string& name) {
  YAML::Node node;
  try {
    node = YAML::Load(text);
  } catch (const YAML::Exception& error) {
    const std::string line = error.mark.is_null() ? "" : " at line " + std::to_string(error.mark.line + 1);
    throw_invalid("configuration '" + name + "' is no YAML" + line + " (" + error.msg + "): correct it there");
  }
  return {node, "", name};
}

YamlSection::YamlSection(const YAML::Node& node, std::string path, std::string file)
    : node_(node), path_(std::move(path)), file_(std::move(file)) {
  if (!node_.IsDefined() || node_.IsNull()) {
    node_ = YAML::Node(YAML::NodeType::Map);
  }
  if (!node_.IsMap()) {
    throw_invalid("configuration '" + file_ + "': " + (path_.empty() ? "it" : path_.substr(0, path_.size() - 1)) +
                  " must be a mapping of keys to values");
  }
  std::set<std::string> seen;
  for (const auto& entry : node_) {
    if (!entry.first.IsScalar()) {
      throw_invalid("configuration '" + file_ + "' line " + std::to_string(entry.first.Mark().line + 1) +
                    ": a key must be a word");
    }
    if (!seen.insert(entry.first.Scalar()).second) {
      throw_invalid("configuration '" + file_ + "': " + path_ + entry.first.Scalar() +
                    " stands there twice: keep one of them");
    }
  }
}

std::string YamlSection::place(const std::string& key) const {
  std::string text = "configuration '" + file_ + "'";
  for (const auto& entry : node_) {
    if (entry.first.Scalar() == key) {
      text += " line " + std::to_string(entry.second.Mark().line + 1);
    }
  }
  return text + ": " + path_ + key;
}

void YamlSection::refuse(const std::string& key, const std::string& what) const {
  throw_invalid(place(key) + ": " + what);
}

bool YamlSection::has(const std::string& key) const {
  for (const auto& entry : node_) {
    if (entry.first.Scalar() == key) {
      return true;
    }
  }
  return false;
}

YAML::Node YamlSection::find(const std::string& key) {
  asked_.insert(key);
  for (const auto& entry : node_) {
    if (entry.first.Scalar() == key) {
      return entry.second;
    }
  }
  return YAML::Node(YAML::NodeType::Undefined);
}

YamlSection YamlSection::section(const std::string& key) {
  YAML::Node node = find(key);
  if (has(key) && !node.IsMap() && !node.IsNull()) {
    refuse(key, "it must be a mapping of keys to values");
  }
  return {node, path_ + key + ".", file_};
}

std::string YamlSection::scalar(const std::string& key, const YAML::Node& node) const {
  if (!node.IsScalar()) {
    refuse(key,
           node.IsNull() ? "it has no value: give one or leave the key out" : "give one value, no list or mapping");
  }
  return node.Scalar();
}

double YamlSection::number(const std::string& key, const std::string& text) const {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  if (text.empty() || end != text.c_str() + text.size() || !std::isfinite(value)) {
    refuse(key, "'" + text + "' is no finite number");
  }
  return value;
}

int YamlSection::integer(const std::string& key, const std::string& text) const {
  const double value = number(key, text);
  if (value != std::floor(value) || std::abs(value) > std::numeric_limits<int>::max()) {
    refuse(key, "'" + text + "' is no whole number");
  }
  return static_cast<int>(value);
}

void YamlSection::read(const std::string& key, double& value) {
  if (const auto node = find(key); node.IsDefined()) {
    value = number(key, scalar(key, node));
  }
}

void YamlSection::read(const std::string& key, int& value) {
  if (const auto node = find(key); node.IsDefined()) {
    value = integer(key, scalar(key, node));
  }
}

void YamlSection::read(const std::string& key, bool& value) {
  if (const auto node = find(key); node.IsDefined()) {
    const std::string text = scalar(key, node);
    if (text != "true" && text != "false") {
      refuse(key, "'" + text + "' is neither true nor false");
    }
    value = text == "true";
  }
}

void YamlSection::read(const std::string& key, std::string& value) {
  if (const auto node = find(key); node.IsDefined()) {
    value = scalar(key, node);
  }
}

void YamlSection::read(const std::string& key, std::vector<std::string>& values) {
  if (const auto node = find(key); node.IsDefined()) {
    if (!node.IsSequence()) {
      refuse(key, "give a list, like [a, b]");
    }
    values.clear();
    for (const auto& one : node) {
      values.push_back(scalar(key, one));
    }
  }
}

void YamlSection::read(const std::string& key, std::vector<int>& values) {
  std::vector<std::string> texts;
  if (has(key)) {
    read(key, texts);
    values.clear();
    for (const auto& text : texts) {
      values.push_back(integer(key, text));
    }
  }
  asked_.insert(key);
}

void YamlSection::read_choice(const std::string& key, const std::vector<std::string>& names, int& index) {
  if (const auto node = find(key); node.IsDefined()) {
    const std::string text = scalar(key, node);
    for (std::size_t i = 0; i < names.size(); ++i) {
      if (names[i] == text) {
        index = static_cast<int>(i);
        return;
      }
    }
    throw_unknown(place(key), text, names);
  }
}

void YamlSection::finish() const {
  for (const auto& entry : node_) {
    const std::string& key = entry.first.Scalar();
    if (asked_.count(key) == 0) {
      throw_unknown("configuration '" + file_ + "' line " + std::to_string(entry.first.Mark().line + 1) + ": key",
                    path_ + key, [this] {
                      std::vector<std::string> names;
                      for (const auto& name : asked_) {
                        names.push_back(path_ + name);
                      }
                      return names;
                    }());
    }
  }
}

}  // namespace ajna::apps
