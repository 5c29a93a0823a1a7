// SPDX-License-Identifier: MIT
#include "ajna/flight/parameters.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace ajna::flight {
namespace {

constexpr double kAskEvery_s = 1.0;

// ArduPilot's names. The station's id was renamed (4.7), and a second parameter makes it a range.
constexpr const char* kGcsOld = "SYSID_MYGCS";
constexpr const char* kGcs = "MAV_GCS_SYSID";
constexpr const char* kGcsHigh = "MAV_GCS_SYSID_HI";
constexpr const char* kOverrideTime = "RC_OVERRIDE_TIME";
constexpr const char* kRcOptions = "RC_OPTIONS";
constexpr const char* kGuidedTimeout = "GUID_TIMEOUT";
constexpr const char* kGuidedOptions = "GUID_OPTIONS";

bool bit(double mask, int index) {
  return mask >= 0.0 && mask < 4294967296.0 && (static_cast<std::uint32_t>(std::lround(mask)) >> index & 1U) != 0;
}

std::string number(double value) {
  std::string text = std::to_string(value);
  text.erase(text.find_last_not_of('0') + 1);
  if (text.back() == '.') {
    text.pop_back();
  }
  return text;
}

}  // namespace

const char* to_string(OutputKind kind) noexcept { return kind == OutputKind::kRcOverride ? "rc_override" : "attitude"; }

ParameterCheck::ParameterCheck(OutputKind output, int system_id, double max_override_s)
    : output_(output), system_id_(system_id), max_override_s_(max_override_s) {}

std::optional<double> ParameterCheck::value(const std::string& name) const {
  const auto found = values_.find(name);
  return found == values_.end() ? std::nullopt : std::optional<double>(found->second);
}

std::vector<std::string> ParameterCheck::missing() const {
  std::vector<std::string> names;
  const auto need = [&](const char* name) {
    if (!value(name)) {
      names.emplace_back(name);
    }
  };
  if (output_ == OutputKind::kAttitude) {
    need(kGuidedTimeout);
    need(kGuidedOptions);
    return names;
  }
  if (!value(kGcsOld) && !value(kGcs)) {
    names.emplace_back(kGcs);
    names.emplace_back(kGcsOld);
  } else if (value(kGcs) && *value(kGcs) != system_id_) {
    need(kGcsHigh);  // only the range can still include us
  }
  need(kOverrideTime);
  need(kRcOptions);
  return names;
}

std::vector<std::string> ParameterCheck::wanted(double now_s) {
  if (asked_s_ && now_s - *asked_s_ < kAskEvery_s) {
    return {};
  }
  auto names = missing();
  if (!names.empty()) {
    asked_s_ = now_s;
  }
  return names;
}

void ParameterCheck::received(const std::string& name, double value) {
  constexpr std::array kRead = {kGcsOld, kGcs, kGcsHigh, kOverrideTime, kRcOptions, kGuidedTimeout, kGuidedOptions};
  if (std::find(kRead.begin(), kRead.end(), name) != kRead.end() && std::isfinite(value)) {
    values_[name] = value;
  }
}

void ParameterCheck::reset() {
  values_.clear();
  asked_s_.reset();
}

std::vector<std::string> ParameterCheck::objections() const {
  std::vector<std::string> found;
  const auto too_long = [&](const char* name, double time_s) {
    return std::string(name) + " is " + number(time_s) + " s: commands would outlive this program by that; set it to " +
           number(max_override_s_) + " or less";
  };
  if (output_ == OutputKind::kAttitude) {
    if (const auto timeout = value(kGuidedTimeout); timeout && (*timeout <= 0.0 || *timeout > max_override_s_)) {
      found.push_back(too_long(kGuidedTimeout, *timeout));
    }
    if (const auto options = value(kGuidedOptions); options && bit(*options, 3)) {
      found.emplace_back(
          "GUID_OPTIONS bit 3 makes the autopilot take thrust for thrust instead of climb rate: clear it");
    }
    return found;
  }
  const auto low = value(kGcs) ? value(kGcs) : value(kGcsOld);
  if (low && *low != system_id_) {
    const auto high = value(kGcs) ? value(kGcsHigh) : std::nullopt;
    if (!(high && *high >= *low && system_id_ >= *low && system_id_ <= *high)) {
      found.push_back(std::string(value(kGcs) ? kGcs : kGcsOld) + " is " + number(*low) + " but mavlink.system_id is " +
                      std::to_string(system_id_) +
                      ": the autopilot would drop our overrides without a word; make them equal");
    }
  }
  if (const auto time = value(kOverrideTime)) {
    if (*time == 0.0) {
      found.emplace_back("RC_OVERRIDE_TIME is 0, which disables overrides: set it to 1");
    } else if (*time < 0.0) {
      found.emplace_back("RC_OVERRIDE_TIME is negative: overrides would never end by themselves; set it to 1");
    } else if (*time > max_override_s_) {
      found.push_back(too_long(kOverrideTime, *time));
    } else if (*time < 0.2) {
      found.emplace_back("RC_OVERRIDE_TIME is " + number(*time) +
                         " s: overrides would end between two of ours; set it to 0.5 or more");
    }
  }
  if (const auto options = value(kRcOptions)) {
    if (bit(*options, 0)) {
      found.emplace_back("RC_OPTIONS bit 0 makes the autopilot ignore the pilot's receiver: clear it");
    }
    if (bit(*options, 1)) {
      found.emplace_back("RC_OPTIONS bit 1 makes the autopilot ignore our overrides: clear it");
    }
  }
  return found;
}

ParameterState ParameterCheck::state() const {
  // An objection stands, whatever else is still to come.
  const bool range_pending = value(kGcs) && *value(kGcs) != system_id_ && !value(kGcsHigh);
  if (!objections().empty() && !(range_pending && objections().size() == 1)) {
    return ParameterState::kRefused;
  }
  return missing().empty() ? ParameterState::kOk : ParameterState::kUnknown;
}

std::vector<std::string> ParameterCheck::reasons() const {
  auto found = objections();
  if (found.empty()) {
    std::string names;
    for (const auto& name : missing()) {
      names += (names.empty() ? "" : ", ") + name;
    }
    if (!names.empty()) {
      found.push_back("not yet answered: " + names);
    }
  }
  return found;
}

}  // namespace ajna::flight
