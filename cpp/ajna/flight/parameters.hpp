// SPDX-License-Identifier: MIT
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

#include "ajna/flight/safety.hpp"

namespace ajna::flight {

enum class OutputKind { kRcOverride, kAttitude };
const char* to_string(OutputKind kind) noexcept;

/// Reads the parameters of the autopilot on which it depends whether our commands work and, more importantly, whether
/// they end by themselves when this program is gone. What is not known is not assumed. Pure: no input or output.
class ParameterCheck {
 public:
  /// max_override_s: longest time for which an override (or a guided target) may outlive its sender.
  ParameterCheck(OutputKind output, int system_id, double max_override_s);

  /// The parameters to ask for now: those not answered, each at most once a second.
  std::vector<std::string> wanted(double now_s);
  void received(const std::string& name, double value);
  /// Forget the answers: the autopilot has restarted, or its parameters may have been changed.
  void reset();

  [[nodiscard]] ParameterState state() const;
  /// One sentence per objection; for an unknown state, what is missing.
  [[nodiscard]] std::vector<std::string> reasons() const;
  [[nodiscard]] const std::map<std::string, double>& values() const noexcept { return values_; }

 private:
  [[nodiscard]] std::optional<double> value(const std::string& name) const;
  [[nodiscard]] std::vector<std::string> missing() const;
  [[nodiscard]] std::vector<std::string> objections() const;

  OutputKind output_;
  int system_id_;
  double max_override_s_;
  std::map<std::string, double> values_;
  std::optional<double> asked_s_;
};

}  // namespace ajna::flight
