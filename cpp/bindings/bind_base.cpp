// SPDX-License-Identifier: MIT
#include <memory>

#include "ajna/base/conformal.hpp"
#include "ajna/base/error.hpp"
#include "ajna/base/version.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;

void bind_base(py::module_& m) {
  m.attr("__version__") = kVersion;
  m.attr("build_torch_version") = kBuildTorchVersion;
  py::register_exception_translator([](std::exception_ptr pointer) {
    try {
      if (pointer) {
        std::rethrow_exception(pointer);
      }
    } catch (const Error& error) {
      switch (error.kind()) {
        case ErrorKind::kInvalidArgument:
          PyErr_SetString(PyExc_ValueError, error.what());
          break;
        case ErrorKind::kFileNotFound:
          PyErr_SetString(PyExc_FileNotFoundError, error.what());
          break;
        case ErrorKind::kRuntime:
          PyErr_SetString(PyExc_RuntimeError, error.what());
          break;
      }
    }
  });
  py::class_<ConformalFactors, std::shared_ptr<ConformalFactors>>(
      m, "ConformalFactors", "How far flow intervals reach per share, in units of the expected error of each axis.")
      .def(py::init([](std::vector<double> levels, std::vector<std::array<double, 2>> factors) {
             ConformalFactors made{std::move(levels), std::move(factors)};
             made.check();
             return made;
           }),
           py::arg("levels"), py::arg("factors"), "levels rising inside (0, 1); factors (u, v) per level.")
      .def_readonly("levels", &ConformalFactors::levels)
      .def_readonly("factors", &ConformalFactors::factors)
      .def("at", &ConformalFactors::at, py::arg("p"), "(factor of u, of v) at share p, linear between the levels.")
      .def(py::self == py::self)
      .def(py::pickle([](const ConformalFactors& self) { return py::make_tuple(self.levels, self.factors); },
                      [](const py::tuple& state) {
                        ConformalFactors made{state[0].cast<std::vector<double>>(),
                                              state[1].cast<std::vector<std::array<double, 2>>>()};
                        made.check();
                        return made;
                      }));
  m.def("nearest_name", &nearest_name, py::arg("name"), py::arg("candidates"),
        "The candidate nearest to `name` by edit distance, or '' where none is near.");
}

}  // namespace ajna::bindings
