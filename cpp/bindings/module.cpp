// SPDX-License-Identifier: MIT
#include "bindings.hpp"

PYBIND11_MODULE(_core, m) {
  m.doc() = "Ajna's C++ core: network, loss, synthetic scenes, engine and file formats.";
  ajna::bindings::bind_base(m);
  ajna::bindings::bind_nn(m);
  ajna::bindings::bind_loss(m);
  ajna::bindings::bind_synth(m);
  ajna::bindings::bind_checkpoint(m);
  ajna::bindings::bind_engine(m);
#ifdef AJNA_WITH_VISION
  ajna::bindings::bind_io(m);
  ajna::bindings::bind_geometry(m);
  ajna::bindings::bind_control(m);
  ajna::bindings::bind_tasks(m);
  ajna::bindings::bind_skills(m);
  m.attr("with_vision") = true;
#else
  m.attr("with_vision") = false;
#endif
}
