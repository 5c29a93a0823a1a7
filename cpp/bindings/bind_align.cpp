// SPDX-License-Identifier: MIT
#include "ajna/tasks/align.hpp"
#include "ajna/tasks/uncertainty_map.hpp"
#include "bind_vision.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using namespace ajna::tasks;

void bind_align(py::module_& m);  // bind_tasks.cpp calls it

void bind_align(py::module_& m) {
  py::class_<AlignOptions> options(m, "AlignOptions", "Of align_to.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &AlignOptions::name)
  AJNA_FIELD(max_features);
  AJNA_FIELD(quality);
  AJNA_FIELD(spacing_px);
  AJNA_FIELD(window_px);
  AJNA_FIELD(levels);
  AJNA_FIELD(max_roundtrip_px);
  AJNA_FIELD(inlier_px);
  AJNA_FIELD(min_inliers);
  AJNA_FIELD(min_inlier_ratio);
  AJNA_FIELD(margin_px);
#undef AJNA_FIELD
  py::class_<Alignment> alignment(m, "Alignment", "A frame on the grid of a reference.");
  alignment.def_readonly("found", &Alignment::found)
      .def_readonly("tracked", &Alignment::tracked)
      .def_readonly("inliers", &Alignment::inliers)
      .def_property_readonly("reference_from_frame",
                             [](const Alignment& self) {
                               return Eigen::Matrix<double, 3, 3, Eigen::RowMajor>(self.reference_from_frame.val);
                             })
      .def_property_readonly("image", [](const Alignment& self) {
        py::array_t<std::uint8_t> array({self.image.rows, self.image.cols, 3});
        for (int y = 0; y < self.image.rows; ++y) {
          const auto* row = self.image.ptr<std::uint8_t>(y);
          std::copy(row, row + 3 * static_cast<std::ptrdiff_t>(self.image.cols), array.mutable_data(y, 0, 0));
        }
        return array;
      });
  alignment.def_property_readonly("valid", [](const Alignment& self) { return to_mask(self.valid); });
  alignment.def(
      "within",
      [](const Alignment& self, const py::array& uncertainty) {
        py::array keep;
        const cv::Mat map = uncertainty.ndim() == 3 ? scalar_map(float_mat(uncertainty, keep, 2), ScalarKind::kNorm)
                                                    : float_mat(uncertainty, keep);
        return mat_to_numpy(within(map, self.valid));
      },
      "uncertainty"_a,
      "The scalar map float32 [H, W] of a map [H, W] or [H, W, 2] of the aligned pair; what the frame has no pixels "
      "for gets the median of the rest.");
  m.def(
      "align_to",
      [](const py::array& reference, const py::array& frame, const AlignOptions& chosen) {
        py::array keep_first;
        py::array keep_second;
        const ImageView first = rgb_view(reference, keep_first);
        const ImageView second = rgb_view(frame, keep_second);
        const py::gil_scoped_release release;
        return align_to(first, second, chosen);
      },
      "reference"_a, "frame"_a, "options"_a = AlignOptions{},
      "Take the motion that most of the picture has in common out of a pair; frames: RGB uint8 [H, W, 3].");
  m.def(
      "derotate_frame",
      [](const py::array& frame, const Eigen::Matrix3d& turn, double fov, const AlignOptions& chosen) {
        py::array keep;
        const ImageView view = rgb_view(frame, keep);
        const py::gil_scoped_release release;
        return derotate_frame(view, turn, fov, chosen);
      },
      "frame"_a, "reference_from_frame"_a, "horizontal_fov_rad"_a, "options"_a = AlignOptions{},
      "Take the camera's turning out of a pair; the rotation turns directions in the frame's camera axes into the "
      "reference's.");
}

}  // namespace ajna::bindings
