// SPDX-License-Identifier: MIT
#pragma once

#include <pybind11/eigen.h>
#include <pybind11/numpy.h>

#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "ajna/base/error.hpp"
#include "ajna/base/image_view.hpp"
#include "bindings.hpp"

// Conversions that geometry, control and tasks share.

namespace ajna::bindings {

/// The member of `values` whose to_string is `name`; throws ValueError with the nearest and all known names.
template <typename Enum>
Enum enum_from(const char* kind, const std::string& name, const std::vector<Enum>& values) {
  std::vector<std::string> known;
  for (const Enum value : values) {
    known.emplace_back(to_string(value));
    if (known.back() == name) {
      return value;
    }
  }
  throw_unknown(kind, name, known);
}

/// An enum field as a string property.
template <typename Class, typename Enum>
void def_enum(pybind11::class_<Class>& bound, const char* name, Enum Class::*member, std::vector<Enum> values) {
  bound.def_property(
      name, [member](const Class& self) { return to_string(self.*member); },
      [=](Class& self, const std::string& text) { self.*member = enum_from(name, text, values); });
}

/// A status (or other enum) of a result as a read-only string.
template <typename Class, typename Enum>
void def_status(pybind11::class_<Class>& bound, const char* name, Enum Class::*member) {
  bound.def_property_readonly(name, [member](const Class& self) { return to_string(self.*member); });
}

inline std::string shape_of(const pybind11::array& array) {
  return std::string(pybind11::str(array.dtype())) + " " + std::string(pybind11::str(array.attr("shape")));
}

/// A float32 array as a Mat over its memory (of a contiguous copy, kept in `keep`): [H, W] or [H, W, channels].
inline cv::Mat float_mat(const pybind11::array& array, pybind11::array& keep, int channels = 1) {
  namespace py = pybind11;
  if (!py::isinstance<py::array_t<float>>(array) || array.ndim() != (channels == 1 ? 2 : 3) ||
      (channels != 1 && array.shape(2) != channels)) {
    throw_invalid("map is " + shape_of(array) + ": float32 [H, W] or [H, W, 2] is expected");
  }
  auto packed = py::array_t<float, py::array::c_style>::ensure(array);
  keep = packed;
  return {static_cast<int>(packed.shape(0)), static_cast<int>(packed.shape(1)), CV_MAKETYPE(CV_32F, channels),
          packed.mutable_data()};
}

inline ImageView rgb_view(const pybind11::array& array, pybind11::array& keep) {
  namespace py = pybind11;
  if (!py::isinstance<py::array_t<std::uint8_t>>(array) || array.ndim() != 3 || array.shape(2) != 3) {
    throw_invalid("frame is " + shape_of(array) + ": uint8 [H, W, 3] (RGB) is expected");
  }
  const auto packed = py::array_t<std::uint8_t, py::array::c_style>::ensure(array);
  keep = packed;
  return {packed.data(), static_cast<int>(packed.shape(1)), static_cast<int>(packed.shape(0)), 3, packed.shape(1) * 3};
}

/// A copy of a one-channel Mat as numpy; None for an empty one. CV_8U masks become bool.
inline pybind11::object mat_to_numpy(const cv::Mat& mat) {
  namespace py = pybind11;
  if (mat.empty()) {
    return py::none();
  }
  const std::vector<py::ssize_t> shape = {mat.rows, mat.cols};
  const auto copy = [&](auto array) -> py::object {
    for (int y = 0; y < mat.rows; ++y) {
      const auto* row = mat.ptr<typename decltype(array)::value_type>(y);
      std::copy(row, row + mat.cols, array.mutable_data(y, 0));
    }
    return array;
  };
  if (mat.type() == CV_32F) {
    return copy(py::array_t<float>(shape));
  }
  if (mat.type() == CV_32S) {
    return copy(py::array_t<int>(shape));
  }
  return copy(py::array_t<std::uint8_t>(shape));
}

inline pybind11::object to_mask(const cv::Mat& mat) {
  return mat.empty() ? pybind11::none() : mat_to_numpy(mat).attr("astype")("bool");
}

/// Points as float64 [N, 2].
template <typename Point>
pybind11::array_t<double> points_to_numpy(const std::vector<Point>& points) {
  pybind11::array_t<double> array({static_cast<pybind11::ssize_t>(points.size()), pybind11::ssize_t{2}});
  for (std::size_t i = 0; i < points.size(); ++i) {
    array.mutable_at(i, 0) = static_cast<double>(points[i].x);
    array.mutable_at(i, 1) = static_cast<double>(points[i].y);
  }
  return array;
}

}  // namespace ajna::bindings
