// SPDX-License-Identifier: MIT
#include "ajna/tasks/dodge.hpp"
#include "ajna/tasks/gap.hpp"
#include "ajna/tasks/navigate.hpp"
#include "ajna/tasks/segment.hpp"
#include "bind_vision.hpp"

namespace ajna::bindings {

void bind_align(pybind11::module_& m);  // bind_align.cpp: pairs without what they have in common

namespace py = pybind11;
using namespace py::literals;
using namespace ajna::tasks;
using Eigen::Vector2d;
using Eigen::Vector3d;

namespace {

/// A scalar map from float32 [H, W] (itself) or [H, W, 2] (per axis).
cv::Mat map_from(const py::array& uncertainty, py::array& keep, ScalarKind kind) {
  if (uncertainty.ndim() == 3) {
    return scalar_map(float_mat(uncertainty, keep, 2), kind);
  }
  return float_mat(uncertainty, keep);
}

py::tuple to_tuple(const cv::Rect& box) { return py::make_tuple(box.x, box.y, box.width, box.height); }
Vector2d to_eigen(const cv::Point2d& p) { return {p.x, p.y}; }

/// A cv::Mat member as a read-only property: a float or int map, or (mask) bool.
template <typename Class>
void def_map(py::class_<Class>& bound, const char* name, cv::Mat Class::*member) {
  bound.def_property_readonly(name, [member](const Class& self) { return mat_to_numpy(self.*member); });
}
template <typename Class>
void def_mask(py::class_<Class>& bound, const char* name, cv::Mat Class::*member) {
  bound.def_property_readonly(name, [member](const Class& self) { return to_mask(self.*member); });
}
template <typename Class>
void def_box(py::class_<Class>& bound, const char* name, cv::Rect Class::*member) {
  bound.def_property_readonly(name, [member](const Class& self) { return to_tuple(self.*member); });
}

void bind_maps(py::module_& m) {
  py::class_<MapOptions> options(m, "MapOptions", "From a map of uncertainty to regions.");
  options.def(py::init<>());
  def_enum(options, "scalar", &MapOptions::scalar,
           {ScalarKind::kNorm, ScalarKind::kMax, ScalarKind::kX, ScalarKind::kY});
  def_enum(options, "rule", &MapOptions::rule,
           {ThresholdRule::kFixed, ThresholdRule::kQuantile, ThresholdRule::kOtsu, ThresholdRule::kMedianMad});
#define AJNA_FIELD(name) options.def_readwrite(#name, &MapOptions::name)
  AJNA_FIELD(smooth_px);
  AJNA_FIELD(background_px);
  AJNA_FIELD(border_px);
  AJNA_FIELD(low_quantile);
  AJNA_FIELD(high_quantile);
  AJNA_FIELD(min_range);
  AJNA_FIELD(fixed);
  AJNA_FIELD(quantile);
  AJNA_FIELD(mad_factor);
  AJNA_FIELD(open_px);
  AJNA_FIELD(close_px);
  AJNA_FIELD(fill_holes);
  AJNA_FIELD(min_area);
  AJNA_FIELD(max_area);
#undef AJNA_FIELD
  py::class_<Region> region(m, "Region", "A connected region of a mask.");
  region.def_readonly("label", &Region::label)
      .def_property_readonly("centroid_px", [](const Region& self) { return to_eigen(self.centroid_px); })
      .def_readonly("area_px", &Region::area_px)
      .def_readonly("mean", &Region::mean)
      .def_readonly("peak", &Region::peak)
      .def_readonly("outside", &Region::outside)
      .def_readonly("touches_border", &Region::touches_border)
      .def_property_readonly("contrast", &Region::contrast);
  def_box(region, "box", &Region::box);
  py::class_<MapSteps> steps(m, "MapSteps", "A map on its way to regions; what a failed status leaves out is None.");
  def_status(steps, "status", &MapSteps::status);
  def_map(steps, "scalar", &MapSteps::scalar);
  def_map(steps, "normalized", &MapSteps::normalized);
  def_map(steps, "labels", &MapSteps::labels);
  def_mask(steps, "raw_mask", &MapSteps::raw_mask);
  def_mask(steps, "mask", &MapSteps::mask);
  steps.def_readonly("low", &MapSteps::low)
      .def_readonly("high", &MapSteps::high)
      .def_readonly("threshold", &MapSteps::threshold)
      .def_readonly("regions", &MapSteps::regions);
  py::class_<FreeSpace> space(m, "FreeSpace", "The largest connected space without uncertain pixels.");
  space.def_readonly("found", &FreeSpace::found)
      .def_property_readonly("center_px", [](const FreeSpace& self) { return to_eigen(self.center_px); })
      .def_readonly("area_px", &FreeSpace::area_px)
      .def_readonly("clearance_px", &FreeSpace::clearance_px);
  def_mask(space, "mask", &FreeSpace::mask);
  m.def(
      "find_regions",
      [](const py::array& uncertainty, const MapOptions& chosen) {
        py::array keep;
        const cv::Mat map = map_from(uncertainty, keep, chosen.scalar);
        const py::gil_scoped_release release;
        return find_regions(map, chosen);
      },
      "uncertainty"_a, "options"_a = MapOptions{},
      "Scalar map, normalisation, threshold, morphology, components of float32 [H, W] or [H, W, 2].");
  m.def(
      "largest_free_space",
      [](const py::array_t<bool, py::array::c_style | py::array::forcecast>& unsafe,
         const std::optional<std::array<int, 4>>& window) {
        if (unsafe.ndim() != 2) {
          throw_invalid("unsafe mask is " + shape_of(unsafe) + ": bool [H, W] is expected");
        }
        // Only read: OpenCV has no header over constant data.
        const cv::Mat mask(static_cast<int>(unsafe.shape(0)), static_cast<int>(unsafe.shape(1)), CV_8U,
                           const_cast<bool*>(unsafe.data()));
        const cv::Rect part = window ? cv::Rect((*window)[0], (*window)[1], (*window)[2], (*window)[3])
                                     : cv::Rect(0, 0, mask.cols, mask.rows);
        return largest_free_space(mask, part);
      },
      "unsafe"_a, "window"_a = py::none(), "unsafe: bool [H, W]; window: (x, y, width, height), all by default.");
}

void bind_dodge(py::module_& m) {
  py::class_<BackgroundOptions> background(m, "BackgroundOptions",
                                           "Of what a camera at rest sees where nothing happens.");
  background.def(py::init<>());
#define AJNA_FIELD(name) background.def_readwrite(#name, &BackgroundOptions::name)
  AJNA_FIELD(use);
  AJNA_FIELD(smooth_px);
  AJNA_FIELD(border_px);
  AJNA_FIELD(learn_s);
  AJNA_FIELD(absorb_s);
  AJNA_FIELD(deviations);
  AJNA_FIELD(min_rise);
  AJNA_FIELD(noise_factor);
  AJNA_FIELD(max_share);
  AJNA_FIELD(max_turn_rad);
#undef AJNA_FIELD
  py::class_<DodgeOptions> options(m, "DodgeOptions", "Of DodgePipeline.");
  options.def(py::init<>());
#define AJNA_FIELD(name) options.def_readwrite(#name, &DodgeOptions::name)
  AJNA_FIELD(map);
  AJNA_FIELD(min_contrast);
  AJNA_FIELD(min_uncertainty);
  AJNA_FIELD(convex);
  AJNA_FIELD(background);
  AJNA_FIELD(confirm_frames);
  AJNA_FIELD(confirm_s);
  AJNA_FIELD(min_move);
  AJNA_FIELD(gate);
  AJNA_FIELD(max_gap_s);
  AJNA_FIELD(max_miss_s);
  AJNA_FIELD(horizon_s);
  AJNA_FIELD(min_growth_per_s);
  AJNA_FIELD(vertical);
  AJNA_FIELD(direct_hit);
  AJNA_FIELD(horizontal_fov_rad);
#undef AJNA_FIELD
  py::class_<TrackPoint>(m, "TrackPoint", "One detection of the obstacle.")
      .def_readonly("time_s", &TrackPoint::time_s)
      .def_property_readonly("center_px", [](const TrackPoint& self) { return to_eigen(self.center_px); })
      .def_readonly("diameter_px", &TrackPoint::diameter_px);
  py::class_<DodgeResult> result(m, "DodgeResult", "What DodgePipeline says of a frame.");
  def_status(result, "status", &DodgeResult::status);
  def_mask(result, "mask", &DodgeResult::mask);
  result.def_readonly("steps", &DodgeResult::steps)
      .def_readonly("region", &DodgeResult::region)
      .def_readonly("track", &DodgeResult::track)
      .def_readonly("velocity_px_s", &DodgeResult::velocity_px_s)
      .def_readonly("time_to_contact_s", &DodgeResult::time_to_contact_s)
      .def_readonly("contact_from_growth", &DodgeResult::contact_from_growth)
      .def_readonly("impact_px", &DodgeResult::impact_px)
      .def_readonly("safe_direction", &DodgeResult::safe_direction);
  py::class_<DodgePipeline>(m, "DodgePipeline", "Detect an obstacle, track it, predict where it hits, and get away.")
      .def(py::init<const DodgeOptions&>(), "options"_a = DodgeOptions{})
      .def(
          "step",
          [](DodgePipeline& self, const py::array& uncertainty, double time_s, const std::optional<Vector3d>& gyro) {
            py::array keep;
            const cv::Mat map = map_from(uncertainty, keep, self.options().map.scalar);
            const py::gil_scoped_release release;
            return self.step(map, time_s, gyro);
          },
          "uncertainty"_a, "time_s"_a, "angular_velocity_rad_s"_a = py::none(),
          "uncertainty: float32 [H, W] or [H, W, 2] of the pair that ends at time_s.")
      .def("reset", &DodgePipeline::reset);
}

void bind_navigate(py::module_& m) {
  const std::vector<WeightRule> rules = {WeightRule::kLimits, WeightRule::kRescaled, WeightRule::kPrinted};
  py::class_<NavigateOptions> options(m, "NavigateOptions", "Of NavigatePipeline.");
  options.def(py::init<>());
  def_enum(options, "weight", &NavigateOptions::weight, rules);
#define AJNA_FIELD(name) options.def_readwrite(#name, &NavigateOptions::name)
  AJNA_FIELD(map);
  AJNA_FIELD(window_width);
  AJNA_FIELD(window_height);
  AJNA_FIELD(delta);
  AJNA_FIELD(directions);
  AJNA_FIELD(floor);
  AJNA_FIELD(blocked);
  AJNA_FIELD(keep);
  AJNA_FIELD(min_free_area);
  AJNA_FIELD(min_clearance);
  AJNA_FIELD(horizontal_fov_rad);
  AJNA_FIELD(max_gap_s);
#undef AJNA_FIELD
  m.def(
      "navigation_weight",
      [rules](double y_close, double y_other, double y_free, const std::string& rule, double floor) {
        return navigation_weight(enum_from("weight rule", rule, rules), y_close, y_other, y_free, floor);
      },
      "y_close"_a, "y_other"_a, "y_free"_a, "rule"_a = to_string(NavigateOptions{}.weight),
      "floor"_a = NavigateOptions{}.floor, "The weight w of Eq. 3: rule 'limits', 'rescaled' or 'printed' (Eq. 6).");
  py::class_<NavigateResult> result(m, "NavigateResult", "What NavigatePipeline says of a frame.");
  def_status(result, "status", &NavigateResult::status);
  def_box(result, "window", &NavigateResult::window);
  def_box(result, "close_box", &NavigateResult::close_box);
  def_box(result, "other_box", &NavigateResult::other_box);
  result.def_readonly("steps", &NavigateResult::steps)
      .def_readonly("free", &NavigateResult::free)
      .def_readonly("goal_px", &NavigateResult::goal_px)
      .def_readonly("free_px", &NavigateResult::free_px)
      .def_readonly("y_close", &NavigateResult::y_close)
      .def_readonly("y_other", &NavigateResult::y_other)
      .def_readonly("y_free", &NavigateResult::y_free)
      .def_readonly("weight", &NavigateResult::weight)
      .def_readonly("goal_direction", &NavigateResult::goal_direction)
      .def_readonly("free_direction", &NavigateResult::free_direction);
  py::class_<NavigatePipeline>(m, "NavigatePipeline", "The largest free space near the goal, and how much it counts.")
      .def(py::init<const NavigateOptions&>(), "options"_a = NavigateOptions{})
      .def(
          "step",
          [](NavigatePipeline& self, const py::array& uncertainty, double time_s, const Vector3d& goal,
             const std::optional<Vector3d>& gyro) {
            py::array keep;
            const cv::Mat map = map_from(uncertainty, keep, self.options().map.scalar);
            const py::gil_scoped_release release;
            return self.step(map, time_s, goal, gyro);
          },
          "uncertainty"_a, "time_s"_a, "goal_direction"_a = Vector3d(Vector3d::UnitX()),
          "angular_velocity_rad_s"_a = py::none(),
          "uncertainty: float32 [H, W] or [H, W, 2] of the pair that ends at time_s; goal_direction: body frame.")
      .def("reset", &NavigatePipeline::reset);
}

void bind_gap_parts(py::module_& m) {
  py::class_<GapDetectionOptions> detection(m, "GapDetectionOptions", "Of detect_gap.");
  detection.def(py::init<>())
      .def_readwrite("map", &GapDetectionOptions::map)
      .def_readwrite("min_contrast", &GapDetectionOptions::min_contrast)
      .def_readwrite("certain", &GapDetectionOptions::certain)
      .def_readwrite("ring", &GapDetectionOptions::ring)
      .def_readwrite("min_solidity", &GapDetectionOptions::min_solidity)
      .def_readwrite("min_thickness", &GapDetectionOptions::min_thickness)
      .def_readwrite("retries", &GapDetectionOptions::retries);
  py::class_<GapTrackerOptions> tracker(m, "GapTrackerOptions", "Of the contour's tracker.");
  tracker.def(py::init<>());
#define AJNA_FIELD(name) tracker.def_readwrite(#name, &GapTrackerOptions::name)
  AJNA_FIELD(max_features);
  AJNA_FIELD(quality);
  AJNA_FIELD(spacing_px);
  AJNA_FIELD(ring);
  AJNA_FIELD(window_px);
  AJNA_FIELD(levels);
  AJNA_FIELD(max_roundtrip_px);
  AJNA_FIELD(min_features);
  AJNA_FIELD(refill_below);
  AJNA_FIELD(fit);
#undef AJNA_FIELD
  py::class_<GapDetection> found(m, "GapDetection", "The gap in a map.");
  found.def_readonly("found", &GapDetection::found)
      .def_readonly("steps", &GapDetection::steps)
      .def_property_readonly("contour", [](const GapDetection& self) { return points_to_numpy(self.contour); })
      .def_readonly("safe_px", &GapDetection::safe_px)
      .def_readonly("contrast", &GapDetection::contrast)
      .def_readonly("score", &GapDetection::score)
      .def_readonly("certain", &GapDetection::certain);
  def_mask(found, "mask", &GapDetection::mask);
  m.def(
      "detect_gap",
      [](const py::array& uncertainty, const GapDetectionOptions& options) {
        py::array keep;
        const cv::Mat map = map_from(uncertainty, keep, options.map.scalar);
        const py::gil_scoped_release release;
        return detect_gap(map, options);
      },
      "uncertainty"_a, "options"_a = GapDetectionOptions{}, "The gap in float32 [H, W] or [H, W, 2].");
}

void bind_gap(py::module_& m) {
  py::class_<GapOptions> options(m, "GapOptions", "Of GapPipeline.");
  options.def(py::init<>())
      .def_readwrite("detection", &GapOptions::detection)
      .def_readwrite("tracker", &GapOptions::tracker)
      .def_readwrite("min_pairs", &GapOptions::min_pairs)
      .def_readwrite("max_pairs", &GapOptions::max_pairs)
      .def_readwrite("through", &GapOptions::through)
      .def_readwrite("max_gap_s", &GapOptions::max_gap_s);
  py::class_<GapResult> result(m, "GapResult", "What GapPipeline says of a frame.");
  def_status(result, "status", &GapResult::status);
  def_status(result, "side", &GapResult::side);
  def_map(result, "stacked", &GapResult::stacked);
  result.def_readonly("pairs", &GapResult::pairs)
      .def_readonly("detection", &GapResult::detection)
      .def_property_readonly("contour", [](const GapResult& self) { return points_to_numpy(self.contour); })
      .def_readonly("safe_px", &GapResult::safe_px)
      .def_readonly("safe_offset", &GapResult::safe_offset)
      .def_property_readonly("foreground",
                             [](const GapResult& self) { return points_to_numpy(self.features.foreground); })
      .def_property_readonly("background",
                             [](const GapResult& self) { return points_to_numpy(self.features.background); })
      .def_readonly("focus_px", &GapResult::focus_px);
  py::class_<GapPipeline>(m, "GapPipeline", "Find a gap by stacking uncertainty, then carry its contour along.")
      .def(py::init<const GapOptions&, double>(), "options"_a = GapOptions{}, "horizontal_fov_rad"_a = 1.2)
      .def(
          "step",
          [](GapPipeline& self, const py::array& frame, const std::optional<py::array>& uncertainty, double time_s) {
            py::array keep_frame, keep_map;
            const ImageView view = rgb_view(frame, keep_frame);
            const cv::Mat map =
                uncertainty ? map_from(*uncertainty, keep_map, self.options().detection.map.scalar) : cv::Mat();
            const py::gil_scoped_release release;
            return self.step(view, map, time_s);
          },
          "frame"_a, "uncertainty"_a, "time_s"_a,
          "frame: uint8 [H, W, 3]; uncertainty: float32 [H, W] or [H, W, 2] of (reference, frame), None if not wanted.")
      .def_property_readonly("wants_map", &GapPipeline::wants_map)
      .def("reset", &GapPipeline::reset);
}

void bind_segment(py::module_& m) {
  py::class_<SegmentOptions> options(m, "SegmentOptions", "Of segment_pile.");
  options.def(py::init<>());
  def_enum(options, "method", &SegmentOptions::method, {SegmentMethod::kWatershed, SegmentMethod::kGrabCut});
#define AJNA_FIELD(name) options.def_readwrite(#name, &SegmentOptions::name)
  AJNA_FIELD(map);
  AJNA_FIELD(min_contrast);
  AJNA_FIELD(join);
  AJNA_FIELD(inner);
  AJNA_FIELD(outer);
  AJNA_FIELD(grabcut_iterations);
  AJNA_FIELD(side_px);
#undef AJNA_FIELD
  py::class_<SegmentResult> result(m, "SegmentResult", "Attention and, apart from it, segmentation.");
  def_status(result, "status", &SegmentResult::status);
  def_mask(result, "attention", &SegmentResult::attention);
  def_mask(result, "segmentation", &SegmentResult::segmentation);
  def_map(result, "seeds", &SegmentResult::seeds);
  def_box(result, "box", &SegmentResult::box);
  result.def_readonly("steps", &SegmentResult::steps);
  m.def(
      "segment_pile",
      [](const py::array& frame, const py::array& uncertainty, const SegmentOptions& chosen) {
        py::array keep_frame, keep_map;
        const ImageView view = rgb_view(frame, keep_frame);
        const cv::Mat map = map_from(uncertainty, keep_map, chosen.map.scalar);
        const py::gil_scoped_release release;
        return segment_pile(view, map, chosen);
      },
      "frame"_a, "uncertainty"_a, "options"_a = SegmentOptions{},
      "Attention mask and segmentation of a pile; frame: uint8 [H, W, 3], uncertainty: float32 [H, W] or [H, W, 2].");
}

}  // namespace

void bind_tasks(py::module_& m) {
  bind_maps(m);
  bind_align(m);
  bind_dodge(m);
  bind_navigate(m);
  bind_gap_parts(m);
  bind_gap(m);
  bind_segment(m);
}

}  // namespace ajna::bindings
