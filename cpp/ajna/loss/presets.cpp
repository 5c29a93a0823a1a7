// SPDX-License-Identifier: MIT
#include "ajna/loss/presets.hpp"

#include <cmath>
#include <utility>

#include "ajna/base/error.hpp"

namespace ajna::loss {
namespace {

LossConfig terms(TermSpec f, TermSpec h, TermSpec g, double lam, TermSpec parametrization = {"softplus"}) {
  LossConfig config;
  config.f = std::move(f);
  config.h = std::move(h);
  config.g = std::move(g);
  config.lam = lam;
  config.parametrization = std::move(parametrization);
  return config;
}

// A head that predicts a log variance: a = e^(raw/2) is the standard deviation.
TermSpec log_variance() { return {"exp", {{"scale", 0.5}}}; }

constexpr const char* kSquared = "|y~ - y^|_2^2";
constexpr const char* kSquaredError = "(y~ - y^)^2";
constexpr const char* kL1 = "|y~ - y^|_1";
constexpr const char* kSmoothL1 = "0.5 (y~ - y^)^2 if y~ - y^ < 1, else y~ - y^ - 0.5";
constexpr const char* kAngle = "acos(y~^T y^)";
constexpr const char* kPerComponent =
    "Taken per component, so that each axis has its own a; equal to the printed norm for one-dimensional quantities.";

std::vector<Preset> table() {
  const double half_root = 1.0 / std::sqrt(2.0);
  return {
      {"kendall2017", 7, "A. Kendall, Y. Gal, NIPS 2017", "Semantic segmentation", kSquared, "a^-2", "log(a^2)", "1",
       "a^2", std::string("The reference predicts the log variance, hence a = exp(raw/2). ") + kPerComponent,
       terms({"squared_error"}, {"inv_square"}, {"log_square"}, 1.0, log_variance())},
      {"zhou2017", 29, "T. Zhou, M. Brown, N. Snavely, D. Lowe, CVPR 2017", "Monocular depth", kL1, "a", "log(a)",
       "0.2", "0.2 / a",
       "The print multiplies the error by a confidence a and rewards small ones. The reference regularises its "
       "explainability mask by cross-entropy with 1: g = -log(a), with a = 1 / (1 + e^raw) in (0, 1).",
       terms({"l1"}, {"identity"}, {"neg_log"}, 0.2, {"confidence"})},
      {"gast2018", 8, "J. Gast, S. Roth, CVPR 2018", "Optical flow", kSquaredError, "a^-1", "log(a)", "1", "a", "",
       terms({"squared_error"}, {"inv"}, {"log"}, 1.0)},
      {"ilg2018", 18, "E. Ilg et al., ECCV 2018", "Optical flow", kL1, "a^-2", "log(a)", "1", "a^2 / 2", "",
       terms({"l1"}, {"inv_square"}, {"log"}, 1.0)},
      {"feng2019", 15, "D. Feng, L. Rosenbaum, F. Timm, K. Dietmayer, IV 2019", "3D bounding box", kSmoothL1, "",
       "log(a^2)", "2", "2 a^2",
       "h is blank in print. The reference attenuates by the inverse variance and predicts its logarithm: h = a^-2, "
       "a = exp(raw/2). The condition is on |y~ - y^|.",
       terms({"smooth_l1"}, {"inv_square"}, {"log_square"}, 2.0, log_variance())},
      {"zhou2020", 12, "L. Zhou et al. (KFNet), CVPR 2020", "Optical flow", kSquared, "a^-2", "log(a)", "6", "3 a^2",
       kPerComponent, terms({"squared_error"}, {"inv_square"}, {"log"}, 6.0)},
      {"costante2020", 27, "G. Costante, M. Mancini, IEEE T-RO 2020", "Visual odometry", kSquared, "a^-1", "log(a)",
       "1", "a", kPerComponent, terms({"squared_error"}, {"inv"}, {"log"}, 1.0)},
      {"eldesokey2020", 25, "A. Eldesokey et al., CVPR 2020", "Dense depth", kSquared, "a^-1", "log(a)", "1", "a",
       kPerComponent, terms({"squared_error"}, {"inv"}, {"log"}, 1.0)},
      {"poggi2020", 26, "M. Poggi, F. Aleotti, F. Tosi, S. Mattoccia, CVPR 2020", "Monocular depth", kL1, "a^-1",
       "log(a)", "1", "a", "", terms({"l1"}, {"inv"}, {"log"}, 1.0)},
      {"singh2021", 36, "C. D. Singh et al. (NudgeSeg), IROS 2021", "Optical flow", kL1, "1 / log(1 + e^(a^2))",
       "log(1 + e^a)", "1", "softplus(a + eps)^2 sigmoid(a) / sigmoid(a + eps)",
       "With a^2 in the exponent kappa falls near a = 0. The paper's Eq. 1, which it takes from this reference, has "
       "a + eps there, eps = 1e-3.",
       terms({"l1"}, {"inv_softplus"}, {"softplus"}, 1.0, {"none"})},
      {"yuan2021", 20, "W. Yuan et al., IROS 2021", "Stereo disparity", kL1, "a^-1", "log(a)", "1/sqrt(2)",
       "a / sqrt(2)", "", terms({"l1"}, {"inv"}, {"log"}, half_root)},
      {"li2021", 19, "S. Li, X. Wu, Y. Cao, H. Zha, CVPR 2021", "Monocular depth", kL1, "a^-1", "log(a)", "1", "a", "",
       terms({"l1"}, {"inv"}, {"log"}, 1.0)},
      {"bae2021", 21, "G. Bae, I. Budvytis, R. Cipolla, ICCV 2021", "Surface normals", kAngle, "-a",
       "log((1 + e^(a^2)) / (1 + a^2))", "1", "2 c / (c^2 + 1) + pi / (1 + e^(pi c)), c = 1/a",
       "The reference is the angular von Mises-Fisher likelihood, c acos(y~^T y^) - log((c^2 + 1) / (1 + e^(-c pi))), "
       "with a concentration c. Here a = 1/c, so that a rises with the expected angle.",
       terms({"angular"}, {"inv"}, {"angular_vmf"}, 1.0)},
      {"kang2021", 17, "J.-G. Kang, S.-D. Roh, K.-S. Chung (FlowNetU), AIPR 2021", "Optical flow", kSquaredError,
       "a^-2", "log(a^2)", "2", "2 a^2", "", terms({"squared_error"}, {"inv_square"}, {"log_square"}, 2.0)},
      {"bhatt2021", 23, "D. Bhatt et al. (f-Cal), arXiv:2109.13913", "Monocular depth", kSquaredError, "a^-2",
       "log(a^2)", "1", "a^2", "", terms({"squared_error"}, {"inv_square"}, {"log_square"}, 1.0)},
      {"martinbrualla2021", 24, "R. Martin-Brualla et al. (NeRF in the Wild), CVPR 2021", "Pixel color", kSquared,
       "a^-2", "log(a^2)", "1", "a^2", "One a per pixel: f is the squared norm over the colour channels.",
       terms({"squared_l2"}, {"inv_square"}, {"log_square"}, 1.0)},
      {"roessle2021", 22, "B. Roessle et al., arXiv:2112.03288", "Monocular depth", kSquaredError, "a^-2", "log(a^2)",
       "1", "a^2", "", terms({"squared_error"}, {"inv_square"}, {"log_square"}, 1.0)},
      {"ajna2023", 0, "N. J. Sanket et al. (Ajna), Science Robotics 2023, Eq. 1", "Optical flow", kL1,
       "1 / log(1 + e^(a + eps))", "log(1 + e^a)", "1", "softplus(a + eps)^2 sigmoid(a) / sigmoid(a + eps)",
       "eps = 1e-3; kappa is about softplus(a)^2.", LossConfig{}},
      {"zhou2017_printed", 29, "Table 3 as printed", "Monocular depth", kL1, "a", "log(a)", "0.2", "-0.2 / a",
       "Inadmissible: h rises with a and kappa is negative; a falls to 0, whatever the error.",
       terms({"l1"}, {"identity"}, {"log"}, 0.2)},
      {"feng2019_printed", 15, "Table 3 as printed", "3D bounding box", kSmoothL1, "", "log(a^2)", "2", "undefined",
       "Inadmissible: the blank h is read as 1, so nothing attenuates the error and a falls to 0.",
       terms({"smooth_l1"}, {"one"}, {"log_square"}, 2.0)},
      {"singh2021_printed", 36, "Table 3 as printed", "Optical flow", kL1, "1 / log(1 + e^(a^2))", "log(1 + e^a)", "1",
       "softplus(a^2)^2 sigmoid(a) / (2 a sigmoid(a^2))",
       "Inadmissible: h rises below a = 0, and kappa has a pole at a = 0 and falls just above it.",
       terms({"l1"}, {"inv_softplus_square"}, {"softplus"}, 1.0, {"none"})},
      {"bae2021_printed", 21, "Table 3 as printed", "Surface normals", kAngle, "-a", "log((1 + e^(a^2)) / (1 + a^2))",
       "1", "2 a / (1 + e^(-a^2)) - 2 a / (1 + a^2)",
       "Inadmissible: h is negative, so the loss grows as the angle shrinks, and kappa is negative near a = 0.",
       terms({"angular"}, {"neg"}, {"angular_printed"}, 1.0)},
  };
}

}  // namespace

const std::vector<Preset>& presets() {
  static const std::vector<Preset> all = table();
  return all;
}

const Preset& preset(const std::string& name) {
  std::vector<std::string> known;
  for (const auto& entry : presets()) {
    if (entry.name == name) return entry;
    known.push_back(entry.name);
  }
  throw_unknown("loss preset", name, known);
}

}  // namespace ajna::loss
