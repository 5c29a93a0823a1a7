// SPDX-License-Identifier: MIT
#include "ajna/control/command.hpp"
#include "ajna/control/pid.hpp"
#include "ajna/control/policies.hpp"
#include "bind_vision.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using namespace ajna::control;

namespace {

void bind_command(py::module_& m) {
  py::class_<Command> command(m, "Command", "What a policy asks of the autopilot; vectors are forward, right, down.");
  def_status(command, "mode", &Command::mode);
  command.def_readonly("velocity_m_s", &Command::velocity_m_s)
      .def_readonly("acceleration_m_s2", &Command::acceleration_m_s2)
      .def_readonly("yaw_rate_rad_s", &Command::yaw_rate_rad_s)
      .def_property_readonly("thrust_m_s2", &Command::thrust_m_s2);
  py::class_<PidOptions> options(m, "PidOptions", "Gains, limits and filter of a Pid.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &PidOptions::name)
  AJNA_FIELD(kp);
  AJNA_FIELD(ki);
  AJNA_FIELD(kd);
  AJNA_FIELD(derivative_cutoff_hz);
  AJNA_FIELD(output_min);
  AJNA_FIELD(output_max);
  AJNA_FIELD(max_dt_s);
#undef AJNA_FIELD
  py::class_<Pid>(m, "Pid", "A discrete PID controller with anti-windup and a filtered derivative (Eq. 5).")
      .def(py::init<const PidOptions&>(), "options"_a = PidOptions{})
      .def("update", &Pid::update, "error"_a, "dt_s"_a, "One step; a step that is no step repeats the last output.")
      .def("reset", &Pid::reset)
      .def_property_readonly("output", &Pid::output)
      .def_property_readonly("integral", &Pid::integral);
}

void bind_dodge_policy(py::module_& m) {
  py::class_<DodgePolicyOptions> options(m, "DodgePolicyOptions", "Of DodgePolicy.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &DodgePolicyOptions::name)
  AJNA_FIELD(speed_m_s);
  AJNA_FIELD(hold_s);
  AJNA_FIELD(longest_s);
  AJNA_FIELD(settle_s);
  AJNA_FIELD(burst_m_s2);
  AJNA_FIELD(max_down_m_s);
  AJNA_FIELD(max_turn_rad);
#undef AJNA_FIELD
  py::class_<DodgePolicy>(m, "DodgePolicy", "Moves in the safe direction and keeps at it.")
      .def(py::init<const DodgePolicyOptions&>(), "options"_a = DodgePolicyOptions{})
      .def("update", &DodgePolicy::update, "safe_direction"_a, "time_s"_a,
           "safe_direction: (x right, y down) in the image plane, or None.")
      .def("reset", &DodgePolicy::reset)
      .def_property_readonly("dodging", &DodgePolicy::dodging);
}

void bind_navigate_policy(py::module_& m) {
  py::class_<NavigatePolicyOptions> options(m, "NavigatePolicyOptions", "Of NavigatePolicy.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &NavigatePolicyOptions::name)
  AJNA_FIELD(speed_m_s);
  AJNA_FIELD(slow_down);
  AJNA_FIELD(direction);
  AJNA_FIELD(yaw);
  AJNA_FIELD(max_acceleration_m_s2);
  AJNA_FIELD(max_forward_m_s2);
  AJNA_FIELD(speed_up_s);
  AJNA_FIELD(max_jerk_m_s3);
  AJNA_FIELD(lookahead_s);
  AJNA_FIELD(weave);
  AJNA_FIELD(weave_hz);
  AJNA_FIELD(delay_s);
#undef AJNA_FIELD
  py::class_<Guidance>(m, "Guidance", "What the local planner says of a frame: v_g, v_free (body frame) and w.")
      .def(py::init([](const Eigen::Vector3d& goal, const Eigen::Vector3d& free, double weight) {
             return Guidance{goal, free, weight, std::nullopt};
           }),
           "goal"_a, "free"_a, "weight"_a)
      .def_readwrite("goal", &Guidance::goal)
      .def_readwrite("free", &Guidance::free)
      .def_readwrite("weight", &Guidance::weight);
  m.def("desired_direction", &desired_direction, "guidance"_a, "(1 - w) v_g + w v_free, of unit length (Eq. 3).");
  py::class_<NavigatePolicy>(m, "NavigatePolicy",
                             "Yaw rate and net thrust towards the desired direction (Eqs. 3 to 5).")
      .def(py::init<const NavigatePolicyOptions&>(), "options"_a = NavigatePolicyOptions{})
      .def("update", &NavigatePolicy::update, "guidance"_a, "time_s"_a, "velocity_m_s"_a = py::none())
      .def("reset", &NavigatePolicy::reset);
}

void bind_gap_policy(py::module_& m) {
  py::class_<ExploreOptions> explore_options(m, "ExploreOptions", "Of the exploratory manoeuvre.");
  explore_options.def(py::init<>())
      .def_readwrite("speed_m_s", &ExploreOptions::speed_m_s)
      .def_readwrite("duration_s", &ExploreOptions::duration_s)
      .def_readwrite("frequency_hz", &ExploreOptions::frequency_hz);
  def_enum(explore_options, "kind", &ExploreOptions::kind, {ExploreKind::kDiagonal, ExploreKind::kExcitedHover});
  m.def("explore", &explore, "options"_a, "elapsed_s"_a, "The exploratory manoeuvre's command; hold when it is over.");
  py::class_<GapPolicyOptions> options(m, "GapPolicyOptions", "Of GapPolicy.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &GapPolicyOptions::name)
  AJNA_FIELD(servo);
  AJNA_FIELD(forward_m_s);
  AJNA_FIELD(aligned);
  AJNA_FIELD(realign);
  AJNA_FIELD(lost_hold_s);
  AJNA_FIELD(coast_m_s);
  AJNA_FIELD(coast_duration_s);
#undef AJNA_FIELD
  py::class_<GapPolicy>(m, "GapPolicy", "Steers the safe point to the image's centre, and through.")
      .def(py::init<const GapPolicyOptions&>(), "options"_a = GapPolicyOptions{})
      .def("update", &GapPolicy::update, "offset"_a, "through"_a, "time_s"_a,
           "offset: the safe point in normalised image coordinates, or None where the gap is lost.")
      .def("reset", &GapPolicy::reset)
      .def_property_readonly("finished", &GapPolicy::finished);
}

}  // namespace

void bind_control(py::module_& m) {
  bind_command(m);
  bind_dodge_policy(m);
  bind_navigate_policy(m);
  bind_gap_policy(m);
}

}  // namespace ajna::bindings
