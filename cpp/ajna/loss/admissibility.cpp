// SPDX-License-Identifier: MIT
#include "ajna/loss/admissibility.hpp"

#include <cmath>
#include <sstream>

#include "ajna/base/error.hpp"

namespace ajna::loss {

using torch::Tensor;

AdmissibilityReport check(const UncertaintyLoss& loss, double raw_min, double raw_max) {
  if (!std::isfinite(raw_min) || !std::isfinite(raw_max) || raw_min >= raw_max) {
    throw_invalid("domain of raw from " + c10::str(raw_min) + " to " + c10::str(raw_max) +
                  " is empty or not finite: give raw_min < raw_max");
  }
  constexpr std::int64_t kPoints = 64 * 74 + 1;  // 1/64 apart on the default domain, like the checkpoint's table
  constexpr double kRounding = 1e-12;            // relative; a slower rise than this is none
  const auto curves =
      loss.curves(torch::linspace(raw_min, raw_max, kPoints, torch::TensorOptions().dtype(torch::kFloat64)));

  AdmissibilityReport report;
  report.raw_min = raw_min;
  report.raw_max = raw_max;
  report.error_min = curves.kappa[0].item<double>();
  report.error_max = curves.kappa[-1].item<double>();
  std::int64_t first = kPoints;
  // The lowest failing raw; of several conditions that fail there, the first named.
  const auto require = [&](const Tensor& holds, const Tensor& value, const std::string& what, const std::string& why) {
    const auto bad = holds.logical_not().nonzero();
    if (bad.numel() == 0) return;
    const auto index = bad[0][0].item<std::int64_t>();
    if (index >= first) return;
    first = index;
    report.fails_at = curves.raw[index].item<double>();
    std::ostringstream text;
    text << what << " at raw = " << *report.fails_at << " (" << value[index].item<double>() << "): " << why;
    report.reason = text.str();
  };
  const auto finite = curves.h.isfinite() & curves.g.isfinite() & curves.h_slope.isfinite() & curves.g_slope.isfinite();
  require(finite, torch::where(curves.h.isfinite(), curves.g, curves.h), "h or g or a derivative is not finite",
          "choose a parametrization that keeps a in their domain");
  require(curves.h > 0, curves.h, "h is not positive", "the loss would push predictions away from their targets");
  require(curves.h_slope < 0, curves.h_slope, "h does not fall with raw",
          "a larger raw would not discount larger errors");
  require(curves.kappa.isfinite() & (curves.kappa > 0), curves.kappa, "kappa = -lam g'/h' is not positive",
          "no expected error makes this raw optimal");
  const auto rise = curves.kappa.diff();
  const auto level = curves.kappa.slice(0, 0, kPoints - 1).abs();
  require(rise > kRounding * level, rise, "kappa = -lam g'/h' does not rise",
          "raw here is no minimum of the loss, so it does not grow with the expected error");
  report.admissible = !report.fails_at;
  return report;
}

}  // namespace ajna::loss
