// SPDX-License-Identifier: MIT
#include "ajna/geometry/camera.hpp"
#include "ajna/geometry/focus_of_expansion.hpp"
#include "ajna/geometry/motion_field.hpp"
#include "bind_vision.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using Eigen::Vector2d;
using Eigen::Vector3d;
using geometry::Camera;
using geometry::FitOptions;
using Points = Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>;

namespace {

std::vector<Vector2d> to_points(const Points& rows) {
  std::vector<Vector2d> points;
  for (Eigen::Index i = 0; i < rows.rows(); ++i) {
    points.emplace_back(rows.row(i));
  }
  return points;
}

py::array_t<bool> to_numpy(const std::vector<bool>& flags) {
  py::array_t<bool> array(static_cast<py::ssize_t>(flags.size()));
  std::copy(flags.begin(), flags.end(), array.mutable_data());
  return array;
}

void bind_camera(py::module_& m) {
  py::class_<Camera> camera(m, "Camera", "A pinhole camera; optical frame x right, y down, z forward.");
  camera.def(py::init<>())
      .def_static("from_horizontal_fov", &Camera::from_horizontal_fov, "width"_a, "height"_a, "fov_rad"_a)
      .def("normalize", &Camera::normalize, "pixel"_a, "Pixel (x, y) -> (X / Z, Y / Z).")
      .def("to_pixel", &Camera::to_pixel, "normalized"_a)
      .def("ray", &Camera::ray, "pixel"_a, "Unit vector in the optical frame.")
      .def("project", &Camera::project, "point"_a, "Pixel of a point in the optical frame; None behind the camera.")
      .def("contains", &Camera::contains, "pixel"_a)
      .def("resized", &Camera::resized, "new_width"_a, "new_height"_a, "The same camera after resizing its image.");
#define AJNA_FIELD(name) camera.def_readwrite(#name, &Camera::name)
  AJNA_FIELD(width);
  AJNA_FIELD(height);
  AJNA_FIELD(fx);
  AJNA_FIELD(fy);
  AJNA_FIELD(cx);
  AJNA_FIELD(cy);
#undef AJNA_FIELD
}

void bind_fits(py::module_& m) {
  py::class_<FitOptions> options(m, "FitOptions", "Of the robust fits.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &FitOptions::name)
  AJNA_FIELD(inlier_px);
  AJNA_FIELD(min_motion_px);
  AJNA_FIELD(min_inliers);
  AJNA_FIELD(min_inlier_ratio);
  AJNA_FIELD(max_uncertainty_px);
  AJNA_FIELD(trials);
  AJNA_FIELD(refinements);
  AJNA_FIELD(seed);
#undef AJNA_FIELD
  using geometry::Expansion;
  using geometry::FocusOfExpansion;
  py::class_<FocusOfExpansion> focus(m, "FocusOfExpansion", "Where the motion of a translating camera leads from.");
  def_status(focus, "status", &FocusOfExpansion::status);
  focus.def_readonly("point_px", &FocusOfExpansion::point_px)
      .def_readonly("covariance_px2", &FocusOfExpansion::covariance_px2)
      .def_readonly("inliers", &FocusOfExpansion::inliers)
      .def_property_readonly("is_inlier", [](const FocusOfExpansion& self) { return to_numpy(self.is_inlier); });
  py::class_<Expansion> expansion(m, "Expansion", "Common image motion of a near-planar region that faces the camera.");
  def_status(expansion, "status", &Expansion::status);
  expansion.def_readonly("rate", &Expansion::rate)
      .def_readonly("shift_px", &Expansion::shift_px)
      .def_readonly("rate_sigma", &Expansion::rate_sigma)
      .def_readonly("inliers", &Expansion::inliers)
      .def_property_readonly("is_inlier", [](const Expansion& self) { return to_numpy(self.is_inlier); })
      .def_property_readonly("magnification", &Expansion::magnification)
      .def_property_readonly("has_focus", &Expansion::has_focus)
      .def_property_readonly("focus_px", &Expansion::focus_px)
      .def("apply", &Expansion::apply, "begin"_a);
  m.def(
      "focus_of_expansion",
      [](const Points& begin, const Points& end, const FitOptions& fit) {
        const auto from = to_points(begin), to = to_points(end);
        const py::gil_scoped_release release;
        return geometry::focus_of_expansion(from, to, fit);
      },
      "begin"_a, "end"_a, "options"_a = FitOptions{}, "Robust focus of expansion of matches [N, 2] in pixels.");
  m.def(
      "fit_expansion",
      [](const Points& begin, const Points& end, const FitOptions& fit) {
        const auto from = to_points(begin), to = to_points(end);
        const py::gil_scoped_release release;
        return geometry::fit_expansion(from, to, fit);
      },
      "begin"_a, "end"_a, "options"_a = FitOptions{}, "Robust expansion of matches [N, 2] in pixels.");
}

}  // namespace

void bind_geometry(py::module_& m) {
  bind_camera(m);
  bind_fits(m);
  m.def(
      "motion_field",
      [](const Camera& camera, const py::array& inverse_depth, const Vector3d& velocity_m_s,
         const Vector3d& angular_velocity_rad_s, double dt_s) {
        py::array keep;
        const cv::Mat mat = float_mat(inverse_depth, keep);
        const std::vector<float> values(mat.ptr<float>(), mat.ptr<float>() + mat.total());
        const auto flow = geometry::motion_field(camera, values, {velocity_m_s, angular_velocity_rad_s}, dt_s);
        py::array_t<float> array({py::ssize_t{mat.rows}, py::ssize_t{mat.cols}, py::ssize_t{2}});
        std::copy(flow.begin(), flow.end(), array.mutable_data());
        return array;
      },
      "camera"_a, "inverse_depth"_a, "velocity_m_s"_a, "angular_velocity_rad_s"_a, "dt_s"_a,
      "Flow float32 [H, W, 2] in pixels from inverse depth float32 [H, W] and the camera's motion (Eq. 14).");
  m.def("rotate_pixel", &geometry::rotate_pixel, "camera"_a, "pixel"_a, "angular_velocity_rad_s"_a, "dt_s"_a,
        "Where a point is seen after the camera has only turned.");
  m.def("derotate_pixel", &geometry::derotate_pixel, "camera"_a, "pixel"_a, "angular_velocity_rad_s"_a, "dt_s"_a,
        "The inverse of rotate_pixel.");
  m.def(
      "derotate_flow",
      [](const Camera& camera, const py::array& flow, const Vector3d& angular_velocity_rad_s, double dt_s) {
        py::array keep;
        const cv::Mat mat = float_mat(flow, keep, 2);
        FlowField field;
        field.width = mat.cols;
        field.height = mat.rows;
        field.flow.assign(mat.ptr<float>(), mat.ptr<float>() + 2 * mat.total());
        geometry::derotate_flow(camera, angular_velocity_rad_s, dt_s, field);
        py::array_t<float> array({py::ssize_t{mat.rows}, py::ssize_t{mat.cols}, py::ssize_t{2}});
        std::copy(field.flow.begin(), field.flow.end(), array.mutable_data());
        return array;
      },
      "camera"_a, "flow"_a, "angular_velocity_rad_s"_a, "dt_s"_a,
      "Flow float32 [H, W, 2] without the camera's turn, which a gyro measures in the optical frame.");
}

}  // namespace ajna::bindings
