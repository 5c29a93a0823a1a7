// SPDX-License-Identifier: MIT
#pragma once

#include <yaml-cpp/yaml.h>

#include <set>
#include <string>
#include <vector>

namespace ajna::apps {

/// One mapping of a YAML file, read strictly: every value has a type, every key must be asked for, and none may stand
/// there twice. All errors are ajna::Error(kInvalidArgument), with the key's path and line.
class YamlSection {
 public:
  /// The whole of `text`; an empty one is an empty mapping. `name` is for messages.
  static YamlSection parse(const std::string& text, const std::string& name);

  /// The mapping under `key`; an empty one where the key is missing.
  YamlSection section(const std::string& key);
  /// Overwrite `value` where the key is there; integers must be whole, numbers finite.
  void read(const std::string& key, double& value);
  void read(const std::string& key, int& value);
  void read(const std::string& key, bool& value);
  void read(const std::string& key, std::string& value);
  void read(const std::string& key, std::vector<std::string>& values);
  void read(const std::string& key, std::vector<int>& values);
  /// One of `names`, as its index.
  void read_choice(const std::string& key, const std::vector<std::string>& names, int& index);
  [[nodiscard]] bool has(const std::string& key) const;
  /// Throws where a key was not asked for, with the nearest that would have been.
  void finish() const;
  /// Throw for a value of `key` that was read but cannot be used.
  [[noreturn]] void refuse(const std::string& key, const std::string& what) const;

 private:
  YamlSection(const YAML::Node& node, std::string path, std::string file);
  [[nodiscard]] std::string place(const std::string& key) const;
  YAML::Node find(const std::string& key);
  std::string scalar(const std::string& key, const YAML::Node& node) const;
  double number(const std::string& key, const std::string& text) const;
  int integer(const std::string& key, const std::string& text) const;

  YAML::Node node_;
  std::string path_;  ///< "safety." or empty
  std::string file_;
  std::set<std::string> asked_;
};

}  // namespace ajna::apps
