// SPDX-License-Identifier: MIT
#include <pybind11/numpy.h>
#include <pybind11/stl/filesystem.h>

#include <filesystem>
#include <memory>
#include <string>
#include <utility>

#include "ajna/base/error.hpp"
#include "ajna/io/flow_io.hpp"
#include "ajna/io/image_io.hpp"
#include "ajna/io/pfm_io.hpp"
#include "ajna/io/video_source.hpp"
#include "ajna/io/video_writer.hpp"
#include "bindings.hpp"

namespace ajna::bindings {

namespace py = pybind11;
using namespace py::literals;
using std::filesystem::path;

namespace {

/// A numpy array over memory that `owner` keeps alive: no copy.
template <typename T, typename Owner>
py::array_t<T> adopt(Owner owner, T* (*data)(Owner&), std::vector<py::ssize_t> shape) {
  auto kept = std::make_unique<Owner>(std::move(owner));
  T* pointer = data(*kept);
  const py::capsule capsule(kept.get(), [](void* p) { delete static_cast<Owner*>(p); });
  kept.release();
  return py::array_t<T>(std::move(shape), pointer, capsule);
}

py::array_t<std::uint8_t> to_numpy(Image image) {
  const std::vector<py::ssize_t> shape = {image.height(), image.width(), 3};
  return adopt<std::uint8_t, Image>(
      std::move(image), [](Image& i) { return i.data(); }, shape);
}

py::array_t<float> to_numpy(std::vector<float> values, std::vector<py::ssize_t> shape) {
  return adopt<float, std::vector<float>>(
      std::move(values), [](std::vector<float>& v) { return v.data(); }, std::move(shape));
}

std::string describe(const py::array& array) {
  return std::string(py::str(array.dtype())) + " " + std::string(py::str(array.attr("shape")));
}

int side(py::ssize_t extent) { return extent > 0x7FFFFFFF ? 0x7FFFFFFF : static_cast<int>(extent); }

/// `array` as C-contiguous T, never cast: float64 to uint8 would pass silently otherwise.
template <typename T>
py::array_t<T, py::array::c_style> contiguous(const py::array& array, const char* expected) {
  if (!py::isinstance<py::array_t<T>>(array)) {
    throw_invalid("array is " + describe(array) + ": " + expected + " is expected");
  }
  return py::array_t<T, py::array::c_style>::ensure(array);
}

py::array_t<std::uint8_t, py::array::c_style> rgb_array(const py::array& array) {
  constexpr const char* kExpected = "uint8 [H, W, 3] (RGB)";
  auto rgb = contiguous<std::uint8_t>(array, kExpected);
  if (rgb.ndim() != 3 || rgb.shape(2) != 3) {
    throw_invalid("array is " + describe(array) + ": " + kExpected + " is expected");
  }
  return rgb;
}

ImageView view_of(const py::array_t<std::uint8_t, py::array::c_style>& rgb) {
  return {rgb.data(), side(rgb.shape(1)), side(rgb.shape(0)), 3, rgb.shape(1) * 3};
}

using FlowWriter = void (*)(const path&, const io::FlowView&);

void write_flow(FlowWriter writer, const path& file, const py::array& flow, const std::optional<py::array>& valid) {
  constexpr const char* kExpected = "float32 [H, W, 2]";
  const auto values = contiguous<float>(flow, kExpected);
  if (values.ndim() != 3 || values.shape(2) != 2) {
    throw_invalid("array is " + describe(flow) + ": " + kExpected + " is expected");
  }
  io::FlowView view{values.data(), nullptr, side(values.shape(1)), side(values.shape(0))};
  py::array_t<bool, py::array::c_style> mask;
  if (valid) {
    mask = contiguous<bool>(*valid, "bool [H, W] (valid)");
    if (mask.ndim() != 2 || mask.shape(0) != values.shape(0) || mask.shape(1) != values.shape(1)) {
      throw_invalid("valid mask is " + describe(*valid) + " but the flow is " + describe(flow) +
                    ": bool [H, W] of the same size is expected");
    }
    view.valid = reinterpret_cast<const std::uint8_t*>(mask.data());
  }
  const py::gil_scoped_release release;
  writer(file, view);
}

py::array_t<bool> mask_to_numpy(const std::vector<std::uint8_t>& valid, py::ssize_t height, py::ssize_t width) {
  py::array_t<bool> mask({height, width});
  std::copy(valid.begin(), valid.end(), mask.mutable_data());
  return mask;
}

/// Runs `read` without the GIL.
template <typename Read>
auto unlocked(Read read) {
  const py::gil_scoped_release release;
  return read();
}

void bind_files(py::module_& m) {
  m.def(
      "read_image", [](const path& file) { return to_numpy(unlocked([&] { return io::read_image(file); })); }, "path"_a,
      R"(Read a PNG, JPEG, BMP, PPM or PGM file (by content, not by name) -> uint8 [H, W, 3], RGB.

Grey and palette images become RGB, alpha is dropped, deeper samples are rounded to 8 bits. FileNotFoundError where
nothing is there, ValueError for anything that is not a whole image.)");
  m.def(
      "write_image",
      [](const path& file, const py::array& image) {
        const auto rgb = rgb_array(image);
        const ImageView view = view_of(rgb);
        const py::gil_scoped_release release;
        io::write_image(file, view);
      },
      "path"_a, "image"_a,
      "Write uint8 [H, W, 3] RGB atomically; .png, .jpg, .bmp or .ppm by the extension. ValueError, FileNotFoundError "
      "(folder) or RuntimeError (disk).");
  m.def(
      "read_flo",
      [](const path& file) {
        io::FlowImage flow = unlocked([&] { return io::read_flo(file); });
        return to_numpy(std::move(flow.flow), {flow.height, flow.width, 2});
      },
      "path"_a,
      "Read a Middlebury .flo file -> float32 [H, W, 2], pixels, values as stored; see known_flow for unknown pixels. "
      "ValueError for truncated files and lying headers.");
  m.def(
      "write_flo",
      [](const path& file, const py::array& flow, const std::optional<py::array>& valid) {
        write_flow(&io::write_flo, file, flow, valid);
      },
      "path"_a, "flow"_a, "valid"_a = py::none(),
      "Write float32 [H, W, 2] (pixels) as .flo, atomically; pixels where valid (bool [H, W]) is False are stored as "
      "1e10. ValueError where a valid pixel is NaN, infinite or beyond 1e9.");
  m.def(
      "known_flow",
      [](const py::array& flow) {
        const auto values = contiguous<float>(flow, "float32 [H, W, 2]");
        if (values.ndim() != 3 || values.shape(2) != 2) {
          throw_invalid("array is " + describe(flow) + ": float32 [H, W, 2] is expected");
        }
        const auto pixels = static_cast<std::size_t>(values.shape(0) * values.shape(1));
        return mask_to_numpy(io::known_flow(values.data(), pixels), values.shape(0), values.shape(1));
      },
      "flow"_a, "bool [H, W]: False where a component is NaN or beyond 1e9 (the .flo convention for unknown flow).");
  m.def(
      "read_kitti_flow",
      [](const path& file) {
        io::FlowImage flow = unlocked([&] { return io::read_kitti_flow(file); });
        auto valid = mask_to_numpy(flow.valid, flow.height, flow.width);
        return std::make_pair(to_numpy(std::move(flow.flow), {flow.height, flow.width, 2}), valid);
      },
      "path"_a,
      "Read KITTI's 16-bit PNG flow -> (flow float32 [H, W, 2] in pixels, valid bool [H, W]); flow is 0 where "
      "invalid.");
  m.def(
      "write_kitti_flow",
      [](const path& file, const py::array& flow, const std::optional<py::array>& valid) {
        write_flow(&io::write_kitti_flow, file, flow, valid);
      },
      "path"_a, "flow"_a, "valid"_a = py::none(),
      "Write float32 [H, W, 2] (pixels) as KITTI's 16-bit PNG, atomically, rounded to 1/64 pixel. ValueError where a "
      "valid pixel is outside [-512, 511.98].");
  m.def(
      "read_pfm",
      [](const path& file) {
        io::FloatImage image = unlocked([&] { return io::read_pfm(file); });
        return to_numpy(std::move(image.data), {image.height, image.width, image.channels});
      },
      "path"_a, "Read a portable float map, either byte order -> float32 [H, W, C], C = 1 or 3, top row first.");
  m.def(
      "write_pfm",
      [](const path& file, const py::array& image) {
        const auto values = contiguous<float>(image, "float32 [H, W] or [H, W, C]");
        if (values.ndim() != 2 && values.ndim() != 3) {
          throw_invalid("array is " + describe(image) + ": float32 [H, W] or [H, W, C] with C = 1 to 3 is expected");
        }
        const int channels = values.ndim() == 2 ? 1 : side(values.shape(2));
        const float* data = values.data();
        const int width = side(values.shape(1));
        const int height = side(values.shape(0));
        const py::gil_scoped_release release;
        io::write_pfm(file, data, width, height, channels);
      },
      "path"_a, "image"_a,
      "Write float32 [H, W] or [H, W, C], C = 1 to 3, as a portable float map, atomically; two channels are stored as "
      "three with a zero third one.");
}

void bind_video(py::module_& m) {
  py::class_<io::Frame>(m, "Frame", "A frame of a VideoSource.")
      .def_property_readonly(
          "image",
          [](py::object self) {
            auto& image = self.cast<io::Frame&>().image;
            return py::array_t<std::uint8_t>({image.height(), image.width(), 3}, image.data(), self);
          },
          "uint8 [H, W, 3], RGB")
      .def_readonly("timestamp_s", &io::Frame::timestamp_s, "seconds since the first frame (cameras: since opening)")
      .def_readonly("index", &io::Frame::index)
      .def_readonly("name", &io::Frame::name, "file name for folders, 'frame 12' otherwise")
      .def("__repr__", [](const io::Frame& self) {
        return "Frame('" + self.name + "', " + std::to_string(self.image.width()) + "x" +
               std::to_string(self.image.height()) + ", " + std::to_string(self.timestamp_s) + " s)";
      });

  py::class_<io::VideoSource>(m, "VideoSource",
                              R"(Frames from a folder of images (natural order), a video file or a camera index.

Iterate over it, or call next() until it returns None. fps sets the rate of time stamps for folders (30 otherwise) and
overrides it for files. FileNotFoundError, ValueError (empty folder, no video, unequal frames), RuntimeError (camera).)")
      .def(py::init([](const py::object& source, std::optional<double> fps) {
             const std::string name =
                 py::isinstance<py::int_>(source) ? std::string(py::str(source)) : source.cast<path>().string();
             return unlocked([&] { return std::make_unique<io::VideoSource>(name, fps); });
           }),
           "source"_a, "fps"_a = py::none())
      .def("next", &io::VideoSource::next, py::call_guard<py::gil_scoped_release>(),
           "The next Frame, or None at the end.")
      .def("__iter__", [](py::object self) { return self; })
      .def("__next__",
           [](io::VideoSource& self) {
             auto frame = unlocked([&] { return self.next(); });
             if (!frame) {
               throw py::stop_iteration();
             }
             return std::move(*frame);
           })
      .def_property_readonly("width", &io::VideoSource::width, "pixels")
      .def_property_readonly("height", &io::VideoSource::height, "pixels")
      .def_property_readonly("fps", &io::VideoSource::fps, "frames per second; 0 where unknown")
      .def_property_readonly("frame_count", &io::VideoSource::frame_count,
                             "exact for folders, the container's claim for files, None for cameras")
      .def_property_readonly("is_camera", &io::VideoSource::is_camera);

  py::class_<io::VideoWriter>(m, "VideoWriter",
                              R"(Writes .mp4 or .avi that appears under its name only when complete.

Use as a context manager: leaving it normally closes and verifies the file, an exception removes it. Odd sides grow by
one pixel. ValueError, FileNotFoundError (folder), RuntimeError (no encoder, disk).)")
      .def(py::init<const path&, int, int, double>(), "path"_a, "width"_a, "height"_a, "fps"_a,
           py::call_guard<py::gil_scoped_release>())
      .def(
          "write",
          [](io::VideoWriter& self, const py::array& frame) {
            const auto rgb = rgb_array(frame);
            const ImageView view = view_of(rgb);
            const py::gil_scoped_release release;
            self.write(view);
          },
          "frame"_a, "Append uint8 [height, width, 3] RGB.")
      .def("close", &io::VideoWriter::close, py::call_guard<py::gil_scoped_release>(), "Finish, verify, put in place.")
      .def("discard", &io::VideoWriter::discard, py::call_guard<py::gil_scoped_release>(),
           "Give up: remove what was written.")
      .def_property_readonly("frames_written", &io::VideoWriter::frames_written)
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__", [](io::VideoWriter& self, const py::object& type, const py::object&, const py::object&) {
        const bool failed = !type.is_none();
        const py::gil_scoped_release release;
        failed ? self.discard() : self.close();
      });
}

}  // namespace

void bind_io(py::module_& m) {
  bind_files(m);
  bind_video(m);
}

}  // namespace ajna::bindings
