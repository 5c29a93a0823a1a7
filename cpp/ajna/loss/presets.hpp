// SPDX-License-Identifier: MIT
#pragma once

#include <string>
#include <vector>

#include "ajna/loss/uncertainty_loss.hpp"

namespace ajna::loss {

/// A published loss as a choice of f, h, g, lam and raw -> a: a row of the paper's Table 3, the paper's own Eq. 1, or
/// a row exactly as printed where the print cannot be what its reference means.
struct Preset {
  std::string name;      ///< "kendall2017"; "<name>_printed" for a row as printed
  int reference = 0;     ///< number in the paper's list of references; 0 for the paper itself
  std::string citation;  ///< authors, venue, year
  std::string quantity;  ///< what it was used for, Table 3's column y
  std::string printed_f, printed_h, printed_g, printed_lam;  ///< the row as printed
  std::string kappa;                                         ///< the expected f as a function of a, in closed form
  std::string note;  ///< what differs from the print and why; empty where nothing does
  LossConfig config;
};

/// All of them: the rows in the order of Table 3, then ajna2023, then the printed forms.
const std::vector<Preset>& presets();
/// By name; throws Error(kInvalidArgument) for an unknown one, with the nearest known name.
const Preset& preset(const std::string& name);

}  // namespace ajna::loss
