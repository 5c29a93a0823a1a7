// SPDX-License-Identifier: MIT
#pragma once

#include <gtest/gtest.h>

#include <string>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/loss/uncertainty_loss.hpp"

namespace ajna::loss {

inline const auto kDouble = torch::TensorOptions().dtype(torch::kFloat64);

inline LossConfig config_of(TermSpec f, TermSpec h, TermSpec g, TermSpec parametrization = {"none"}, double lam = 1.0) {
  LossConfig config;
  config.f = std::move(f);
  config.h = std::move(h);
  config.g = std::move(g);
  config.parametrization = std::move(parametrization);
  config.lam = lam;
  return config;
}

/// What `function` complains of, as an invalid argument; empty if it does not.
template <class Function>
std::string message_of(Function&& function) {
  try {
    function();
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::kInvalidArgument);
    return error.what();
  }
  return "";
}

}  // namespace ajna::loss
