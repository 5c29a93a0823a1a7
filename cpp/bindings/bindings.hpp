// SPDX-License-Identifier: MIT
#pragma once

#include <pybind11/operators.h>
#include <pybind11/stl.h>
#include <torch/extension.h>

namespace ajna::bindings {

void bind_base(pybind11::module_& m);  ///< version, Error translation
void bind_nn(pybind11::module_& m);
void bind_loss(pybind11::module_& m);
void bind_synth(pybind11::module_& m);
void bind_checkpoint(pybind11::module_& m);  ///< network_input, checkpoints, TorchScript export
void bind_engine(pybind11::module_& m);
#ifdef AJNA_WITH_VISION
void bind_io(pybind11::module_& m);  ///< images, flow files, video
void bind_geometry(pybind11::module_& m);
void bind_control(pybind11::module_& m);
void bind_tasks(pybind11::module_& m);
void bind_skills(pybind11::module_& m);
#endif

}  // namespace ajna::bindings
