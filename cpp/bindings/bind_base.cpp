// SPDX-License-Identifier: MIT
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
  m.def("nearest_name", &nearest_name, py::arg("name"), py::arg("candidates"),
        "The candidate nearest to `name` by edit distance, or '' where none is near.");
}

}  // namespace ajna::bindings
