// SPDX-License-Identifier: MIT
#include <pybind11/functional.h>
#include <pybind11/stl.h>

#include <memory>
#include <mutex>

#include "ajna/engine/flow_engine.hpp"
#include "ajna/skills/skill.hpp"
#include "bind_vision.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using namespace ajna::skills;
using Eigen::Matrix3d;
using Eigen::Vector3d;

namespace {

/// An object of Python's, kept alive by C++; its end waits for the interpreter.
std::shared_ptr<const void> kept(py::object object) {
  if (object.is_none()) {
    return nullptr;
  }
  return {new py::object(std::move(object)), [](const void* pointer) {
            const py::gil_scoped_acquire acquire;
            delete static_cast<const py::object*>(pointer);
          }};
}

py::object tag_of(const Snapshot& snapshot) {
  return snapshot.tag ? *static_cast<const py::object*>(snapshot.tag.get()) : py::none();
}

CommonMotion common_from(const std::string& name) {
  return enum_from<CommonMotion>("common motion", name,
                                 {CommonMotion::kNone, CommonMotion::kRotation, CommonMotion::kPlane});
}

/// A network's signal as an object, so that a skill can call it without Python.
class NetworkSignal {
 public:
  NetworkSignal(py::object engine, double horizontal_fov_rad) : engine_(std::move(engine)) {
    const auto* network = engine_.cast<const engine::FlowEngine*>();
    signal_ = network_signal([network](const ImageView& a, const ImageView& b, FlowField& field,
                                       double time_s) { network->infer_into(a, b, field, time_s); },
                             horizontal_fov_rad);
  }
  [[nodiscard]] const Signal& signal() const noexcept { return signal_; }

 private:
  py::object engine_;
  Signal signal_;
};

/// A function of Python's as a signal.
Signal python_signal(py::function function) {
  const auto shared = std::make_shared<py::function>(std::move(function));
  return [shared](const Snapshot& first, const Snapshot& second, CommonMotion common) {
    const py::gil_scoped_acquire acquire;
    const py::array map = (*shared)(py::cast(first, py::return_value_policy::reference),
                                    py::cast(second, py::return_value_policy::reference), to_string(common));
    py::array keep;
    SignalMap result;
    result.map = map.ndim() == 3 ? tasks::scalar_map(float_mat(map, keep, 2), tasks::ScalarKind::kNorm)
                                 : float_mat(map, keep).clone();
    return result;
  };
}

std::optional<Attitude> attitude_from(const std::optional<Matrix3d>& heading_from_camera, double yaw_rad) {
  return heading_from_camera ? std::optional(Attitude{*heading_from_camera, yaw_rad}) : std::nullopt;
}

struct Input {
  py::array image;  ///< owns what the view shows
  SkillInput input;
};

Input input_from(double time_s, const std::optional<py::array>& frame, const std::optional<Matrix3d>& rotation,
                 double yaw_rad, const std::optional<Vector3d>& velocity, const std::optional<Vector3d>& goal,
                 double too_high_m, py::object tag) {
  Input result;
  if (frame) {
    result.input.frame = rgb_view(*frame, result.image);
  }
  result.input.captured_s = time_s;
  result.input.attitude = attitude_from(rotation, yaw_rad);
  result.input.velocity_m_s = velocity;
  result.input.goal = goal;
  result.input.too_high_m = too_high_m;
  result.input.tag = kept(std::move(tag));
  return result;
}

void bind_horizon(py::module_& m) {
  using tasks::CorridorOptions;
  using tasks::HorizonOptions;
  py::class_<HorizonOptions> horizon(m, "HorizonOptions", "From uncertainty along the horizon to distances.");
  horizon.def(py::init<>());
#define AJNA_FIELD(name) horizon.def_readwrite(#name, &HorizonOptions::name)
  AJNA_FIELD(band);
  AJNA_FIELD(floor);
  AJNA_FIELD(per_px);
  AJNA_FIELD(least_shift_px);
  AJNA_FIELD(saturated);
  AJNA_FIELD(range_moves);
  AJNA_FIELD(max_distance_m);
  AJNA_FIELD(min_move_m);
  AJNA_FIELD(column_step);
#undef AJNA_FIELD
  py::class_<CorridorOptions> corridor(m, "CorridorOptions", "Of the choice of a corridor between things.");
  corridor.def(py::init<>());
#define AJNA_FIELD(name) corridor.def_readwrite(#name, &CorridorOptions::name)
  AJNA_FIELD(half_width_m);
  AJNA_FIELD(bare_m);
  AJNA_FIELD(squeeze_m_s);
  AJNA_FIELD(room_m);
  AJNA_FIELD(crowd_weight);
  AJNA_FIELD(blocked_weight);
  AJNA_FIELD(goal_ahead_m);
  AJNA_FIELD(side_m);
  AJNA_FIELD(fan_rad);
  AJNA_FIELD(directions);
  AJNA_FIELD(blocked_m);
  AJNA_FIELD(wide_fan_rad);
  AJNA_FIELD(horizon_m);
  AJNA_FIELD(support);
  AJNA_FIELD(keep_weight);
  AJNA_FIELD(least_way_m);
  AJNA_FIELD(least_way_s);
  AJNA_FIELD(need_m);
  AJNA_FIELD(aside_rad);
  AJNA_FIELD(camera_ahead_m);
  AJNA_FIELD(brake_m_s2);
  AJNA_FIELD(stop_m);
  AJNA_FIELD(lag_s);
  AJNA_FIELD(turn_per_s);
  AJNA_FIELD(turn_m_s2);
#undef AJNA_FIELD
  using tasks::OccupancyOptions;
  py::class_<OccupancyOptions> occupancy(m, "OccupancyOptions", "How readings of distance become a map of things.");
  occupancy.def(py::init<>());
#define AJNA_FIELD(name) occupancy.def_readwrite(#name, &OccupancyOptions::name)
  AJNA_FIELD(cell_m);
  AJNA_FIELD(seen);
  AJNA_FIELD(passed);
  AJNA_FIELD(sure_m);
  AJNA_FIELD(clear_share);
  AJNA_FIELD(clear_near);
  AJNA_FIELD(thickness);
  AJNA_FIELD(bound);
  AJNA_FIELD(blocked);
  AJNA_FIELD(forget_m);
  AJNA_FIELD(max_range_m);
#undef AJNA_FIELD
  m.def(
      "horizon_obstacles",
      [](const py::array& map, const Matrix3d& rotation, double fov, const Vector3d& move,
         const HorizonOptions& chosen) {
        py::array keep;
        const auto found = tasks::horizon_scan(float_mat(map, keep), {}, rotation, fov, move, chosen)
                               .value_or(tasks::HorizonScan{})
                               .all_things();
        py::array_t<double> points({static_cast<py::ssize_t>(found.size()), py::ssize_t{2}});
        for (std::size_t i = 0; i < found.size(); ++i) {
          points.mutable_at(static_cast<py::ssize_t>(i), 0) = found[i].x();
          points.mutable_at(static_cast<py::ssize_t>(i), 1) = found[i].y();
        }
        return points;
      },
      "map"_a, "heading_from_camera"_a, "horizontal_fov_rad"_a, "move_m"_a, "options"_a = HorizonOptions{},
      "The nearest thing of each column of a scalar map float32 [H, W], as float64 [N, 2]: forward and right of the "
      "camera, metres. move_m: between the frames, heading frame [3].");
}

void bind_options(py::module_& m) {
  using tasks::CloserLookOptions;
  py::class_<CloserLookOptions>(m, "CloserLookOptions", "Of the second, enlarged look at what was found.")
      .def(py::init<>())
      .def_readwrite("enlarge", &CloserLookOptions::enlarge)
      .def_readwrite("width", &CloserLookOptions::width)
      .def_readwrite("height", &CloserLookOptions::height)
      .def_readwrite("margin_px", &CloserLookOptions::margin_px);
  py::class_<SkillOptions> options(m, "SkillOptions", "Of make_skill: one task, its pipeline and its policy.");
  options.def(py::init<>());
  def_enum(options, "task", &SkillOptions::task, {Task::kDodge, Task::kNavigate, Task::kGap});
#define AJNA_FIELD(name) options.def_readwrite(#name, &SkillOptions::name)
  AJNA_FIELD(horizontal_fov_rad);
  AJNA_FIELD(planning_rate_hz);
  AJNA_FIELD(latency_s);
  AJNA_FIELD(max_interval_s);
  AJNA_FIELD(goal_bearing_rad);
  AJNA_FIELD(dodge);
  AJNA_FIELD(dodge_policy);
  AJNA_FIELD(closer_look);
  AJNA_FIELD(horizon);
  AJNA_FIELD(occupancy);
  AJNA_FIELD(corridor);
  AJNA_FIELD(navigate);
  AJNA_FIELD(navigate_policy);
  AJNA_FIELD(max_turn_rad_s);
  AJNA_FIELD(dodge_pair_s);
  AJNA_FIELD(baseline_s);
  AJNA_FIELD(baseline_m);
  AJNA_FIELD(longest_baseline_s);
  AJNA_FIELD(baseline_share);
  AJNA_FIELD(shortest_baseline_s);
  AJNA_FIELD(height_gain);
  AJNA_FIELD(largest_slope);
  AJNA_FIELD(gap);
  AJNA_FIELD(gap_policy);
  AJNA_FIELD(explore);
  AJNA_FIELD(settle_s);
  AJNA_FIELD(rest_m_s);
  AJNA_FIELD(rest_rad);
  AJNA_FIELD(fewest_pairs);
  AJNA_FIELD(first_look_s);
  AJNA_FIELD(last_look_s);
  AJNA_FIELD(slew_m_s2);
#undef AJNA_FIELD
}

void bind_signal(py::module_& m) {
  py::class_<Snapshot>(m, "Snapshot", "A frame that is remembered, with what was known when it was taken.")
      .def(py::init([](double time_s, const std::optional<py::array>& frame, const std::optional<Matrix3d>& rotation,
                       double yaw_rad, py::object tag) {
             Snapshot snapshot;
             if (frame) {
               py::array keep;
               const ImageView view = rgb_view(*frame, keep);
               snapshot.image = Image(view.width, view.height);
               std::copy(view.data, view.data + snapshot.image.size_bytes(), snapshot.image.data());
             }
             snapshot.captured_s = time_s;
             snapshot.attitude = attitude_from(rotation, yaw_rad);
             snapshot.tag = kept(std::move(tag));
             return snapshot;
           }),
           "time_s"_a, "frame"_a = py::none(), "heading_from_camera"_a = py::none(), "yaw_rad"_a = 0.0,
           "tag"_a = py::none())
      .def_readonly("time_s", &Snapshot::captured_s)
      .def_property_readonly("tag", &tag_of);
  py::class_<NetworkSignal>(m, "NetworkSignal",
                            "What a network (the engine of an ajna.Model) says of the flow between two frames.")
      .def(py::init<py::object, double>(), "engine"_a, "horizontal_fov_rad"_a)
      .def(
          "__call__",
          [](const NetworkSignal& self, const Snapshot& first, const Snapshot& second, const std::string& common) {
            const CommonMotion motion = common_from(common);
            SignalMap seen;
            {
              const py::gil_scoped_release release;
              seen = self.signal()(first, second, motion);
            }
            return mat_to_numpy(seen.map);
          },
          "first"_a, "second"_a, "common"_a = "none",
          "Scalar uncertainty float32 [H, W] on the first frame's grid, after the common motion ('none', 'rotation', "
          "'plane') is taken out of the second frame.");
}

}  // namespace

void bind_skills(py::module_& m) {
  bind_horizon(m);
  bind_options(m);
  bind_signal(m);
  py::class_<SkillOutput> output(m, "SkillOutput", "What a skill makes of a frame.");
  output.def_readonly("command", &SkillOutput::command)
      .def_readonly("valid", &SkillOutput::valid)
      .def_readonly("status", &SkillOutput::status)
      .def_readonly("decided", &SkillOutput::decided)
      .def_readonly("point_px", &SkillOutput::point_px)
      .def_property_readonly("mask", [](const SkillOutput& self) { return to_mask(self.mask); })
      .def_property_readonly("map",
                             [](const SkillOutput& self) -> py::object {
                               return self.map.empty() ? py::none() : py::object(mat_to_numpy(self.map));
                             })
      .def_readonly("details", &SkillOutput::details);
  const auto plan = [](Skill& self, double time_s, const std::optional<py::array>& frame,
                       const std::optional<Matrix3d>& rotation, double yaw_rad, const std::optional<Vector3d>& velocity,
                       const std::optional<Vector3d>& goal, double too_high_m, py::object tag) {
    const Input given = input_from(time_s, frame, rotation, yaw_rad, velocity, goal, too_high_m, std::move(tag));
    const py::gil_scoped_release release;
    return self.plan(given.input);
  };
  const auto remember = [](Skill& self, double time_s, const std::optional<py::array>& frame,
                           const std::optional<Matrix3d>& rotation, double yaw_rad, py::object tag) {
    const Input given = input_from(time_s, frame, rotation, yaw_rad, {}, {}, 0.0, std::move(tag));
    const py::gil_scoped_release release;
    self.remember(given.input);
  };
  py::class_<Skill>(m, "Skill", "Signal, pipeline and policy of one task: frames in, commands out.")
      .def(py::init([](const SkillOptions& options, const py::object& signal) {
             if (py::isinstance<NetworkSignal>(signal)) {
               return make_skill(options, signal.cast<const NetworkSignal&>().signal());
             }
             if (!PyCallable_Check(signal.ptr())) {
               throw_invalid("signal is no function: give a NetworkSignal, or signal(first, second, common) -> map");
             }
             return make_skill(options, python_signal(py::reinterpret_borrow<py::function>(signal)));
           }),
           "options"_a, "signal"_a, py::keep_alive<1, 3>())
      .def("plan", plan, "time_s"_a, "frame"_a = py::none(), "heading_from_camera"_a = py::none(), "yaw_rad"_a = 0.0,
           "velocity_m_s"_a = py::none(), "goal"_a = py::none(), "too_high_m"_a = 0.0, "tag"_a = py::none(),
           "Plan on a frame (RGB uint8 [H, W, 3], or None where no picture is needed). heading_from_camera: rotation "
           "[3, 3] from the camera's axes (right, down, forward) to the levelled heading frame (forward, right, down); "
           "yaw_rad: of the heading frame, to the right.")
      .def("remember", remember, "time_s"_a, "frame"_a = py::none(), "heading_from_camera"_a = py::none(),
           "yaw_rad"_a = 0.0, "tag"_a = py::none(), "Only remember a frame that is not planned on.")
      .def(
          "outline",
          [](Skill& self) {
            cv::Mat mask;
            {
              const py::gil_scoped_release release;
              mask = self.outline();
            }
            return to_mask(mask);
          },
          "What the last plan found, outlined more sharply than its mask by a closer look at enlarged pictures: bool "
          "[H, W]; None where nothing was found or stands out, without pictures, and for other tasks. "
          "Runs the network once more: call it when the command is on its way.")
      .def("begin", &Skill::begin, "Begin anew with the next frame.");
}

}  // namespace ajna::bindings
