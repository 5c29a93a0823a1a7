# SPDX-License-Identifier: MIT
"""ajna.io: what crosses the binding. The formats themselves are tested in C++ (tests/cpp/test_*_io.cpp)."""

from __future__ import annotations

import struct
import threading
from pathlib import Path

import numpy as np
import pytest

import ajna  # noqa: F401  (a broken extension must fail here, not skip below)

io = pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)


@pytest.mark.parametrize("extension", ["png", "bmp", "ppm"])
def test_image_round_trip(tmp_path: Path, rgb: np.ndarray, extension: str) -> None:
    path = tmp_path / f"a.{extension}"
    io.write_image(path, rgb)
    read = io.read_image(str(path))
    assert read.dtype == np.uint8
    np.testing.assert_array_equal(read, rgb)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_image_agrees_with_pillow(tmp_path: Path, rgb: np.ndarray) -> None:
    image = pytest.importorskip("PIL.Image")
    io.write_image(tmp_path / "ours.png", rgb)
    np.testing.assert_array_equal(np.asarray(image.open(tmp_path / "ours.png")), rgb)
    rgba = np.dstack([rgb, np.full(rgb.shape[:2], 9, np.uint8)])
    image.fromarray(rgba).save(tmp_path / "theirs.png")
    np.testing.assert_array_equal(io.read_image(tmp_path / "theirs.png"), rgb)
    image.fromarray(rgb).quantize(256).save(tmp_path / "palette.png")
    palette = np.asarray(image.open(tmp_path / "palette.png").convert("RGB"))
    np.testing.assert_array_equal(io.read_image(tmp_path / "palette.png"), palette)
    for name, options in (("baseline", {}), ("progressive", {"progressive": True})):
        image.fromarray(rgb).save(tmp_path / f"{name}.jpg", quality=95, **options)
        theirs = np.asarray(image.open(tmp_path / f"{name}.jpg"))
        assert np.abs(io.read_image(tmp_path / f"{name}.jpg").astype(int) - theirs).max() <= 2


def test_views_are_written_as_they_look(tmp_path: Path, rgb: np.ndarray) -> None:
    for view in (rgb[::-1], rgb[:, ::2], rgb[..., ::-1], np.asfortranarray(rgb)):
        io.write_image(tmp_path / "a.png", view)
        np.testing.assert_array_equal(io.read_image(tmp_path / "a.png"), view)


def test_result_outlives_everything_and_is_writable(tmp_path: Path, rgb: np.ndarray) -> None:
    io.write_image(tmp_path / "a.png", rgb)
    read = io.read_image(tmp_path / "a.png")
    (tmp_path / "a.png").unlink()
    read[0, 0] = 0
    np.testing.assert_array_equal(read[1:], rgb[1:])


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 4, 3)),
        np.zeros((4, 4, 3), np.int8),
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((0, 4, 3), np.uint8),
    ],
)
def test_other_arrays_are_refused_as_images(tmp_path: Path, array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="RGB|0"):
        io.write_image(tmp_path / "a.png", array)
    assert not list(tmp_path.iterdir())


def test_flo_bytes_and_unknown_pixels(tmp_path: Path) -> None:
    flow = np.random.default_rng(1).normal(0, 30, (3, 5, 2)).astype(np.float32)
    io.write_flo(tmp_path / "a.flo", flow)
    assert (tmp_path / "a.flo").read_bytes() == struct.pack("<fii", 202021.25, 5, 3) + flow.astype("<f4").tobytes()
    np.testing.assert_array_equal(io.read_flo(tmp_path / "a.flo"), flow)
    valid = np.ones((3, 5), bool)
    valid[1, 2] = False
    flow[1, 2] = np.nan
    io.write_flo(tmp_path / "b.flo", flow, valid)
    np.testing.assert_array_equal(io.known_flow(io.read_flo(tmp_path / "b.flo")), valid)
    np.testing.assert_array_equal(io.known_flow(flow), valid)
    with pytest.raises(ValueError, match="x 2, y 1"):
        io.write_flo(tmp_path / "c.flo", flow)
    with pytest.raises(ValueError, match="same size"):
        io.write_flo(tmp_path / "c.flo", flow, valid[:2])
    with pytest.raises(ValueError, match="bool"):
        io.write_flo(tmp_path / "c.flo", flow, valid.astype(np.uint8))
    with pytest.raises(ValueError, match="float32"):
        io.write_flo(tmp_path / "c.flo", flow.astype(np.float64))


def test_kitti_flow(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    flow = random.uniform(-500, 500, (6, 4, 2)).astype(np.float32)
    valid = random.random((6, 4)) > 0.4
    io.write_kitti_flow(tmp_path / "a.png", flow, valid)
    read, read_valid = io.read_kitti_flow(tmp_path / "a.png")
    assert read_valid.dtype == np.bool_
    np.testing.assert_array_equal(read_valid, valid)
    np.testing.assert_allclose(read, np.where(valid[..., None], flow, 0), atol=0.5 / 64 + 1e-5)


@pytest.mark.parametrize("channels", [None, 1, 2, 3])
def test_pfm(tmp_path: Path, channels: int | None) -> None:
    shape = (4, 3) if channels is None else (4, 3, channels)
    image = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    io.write_pfm(tmp_path / "a.pfm", image)
    expected = image.reshape(4, 3, -1)
    if channels == 2:
        expected = np.dstack([expected, np.zeros((4, 3, 1), np.float32)])
    np.testing.assert_array_equal(io.read_pfm(tmp_path / "a.pfm"), expected)
    big_endian = b"Pf\n3 4\n1\n" + np.ascontiguousarray(expected[::-1, :, 0]).astype(">f4").tobytes()
    (tmp_path / "b.pfm").write_bytes(big_endian)
    np.testing.assert_array_equal(io.read_pfm(tmp_path / "b.pfm"), expected[..., :1])


@pytest.mark.parametrize("reader", ["read_image", "read_flo", "read_kitti_flow", "read_pfm"])
def test_bad_files_have_the_right_exception(tmp_path: Path, reader: str) -> None:
    read = getattr(io, reader)
    with pytest.raises(FileNotFoundError, match=r"missing\.xyz"):
        read(tmp_path / "missing.xyz")
    with pytest.raises(ValueError, match="is a folder"):
        read(tmp_path)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(ValueError, match="text"):
        read(tmp_path / "text")


def test_unwritable_folder_is_a_plain_error(rgb: np.ndarray) -> None:
    with pytest.raises((RuntimeError, FileNotFoundError), match="folder"):
        io.write_image("/proc/a.png", rgb)  # root, too, cannot create files there


def test_video_source_of_a_folder(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        io.write_image(tmp_path / f"{number}.png", np.full((4, 6, 3), number, np.uint8))
    source = io.VideoSource(tmp_path, fps=5.0)
    assert (source.width, source.height, source.fps, source.frame_count, source.is_camera) == (6, 4, 5.0, 3, False)
    frames = list(source)
    assert [frame.image[0, 0, 0] for frame in frames] == [1, 2, 10]
    assert [frame.timestamp_s for frame in frames] == pytest.approx([0.0, 0.2, 0.4])
    assert frames[2].name == "10.png"
    assert source.next() is None
    image = frames[0].image
    del frames, source
    assert image.sum() == 4 * 6 * 3  # the frame lives as long as its array


def test_video_source_errors(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no images"):
        io.VideoSource(tmp_path)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        io.VideoSource(tmp_path / "nowhere")
    with pytest.raises(RuntimeError, match="camera 987"):
        io.VideoSource(987)
    with pytest.raises(ValueError, match="fps"):
        io.VideoSource(tmp_path, fps=0)


def test_video_writer(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with io.VideoWriter(path, 32, 16, 10.0) as writer:
        for number in range(4):
            writer.write(np.full((16, 32, 3), 60 * number, np.uint8))
        assert not path.exists()
    read = [frame.image.mean() for frame in io.VideoSource(path)]
    assert read == pytest.approx([0, 60, 120, 180], abs=8)
    frames = iter([np.zeros((16, 32, 3), np.uint8)])
    with pytest.raises(StopIteration), io.VideoWriter(tmp_path / "b.mp4", 32, 16, 10.0) as writer:
        [writer.write(next(frames)) for _ in range(2)]
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    with pytest.raises(ValueError, match="closed"):
        writer.write(np.zeros((16, 32, 3), np.uint8))


def test_threads_read_at_the_same_time(tmp_path: Path, rgb: np.ndarray) -> None:
    io.write_image(tmp_path / "a.png", rgb)
    good = []

    def work() -> None:
        for _ in range(50):
            io.write_image(tmp_path / "shared.png", rgb)  # atomic: a reader never sees a part
            good.append(np.array_equal(io.read_image(tmp_path / "shared.png"), rgb))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(good) == 200
    assert all(good)
    assert {file.name for file in tmp_path.iterdir()} == {"a.png", "shared.png"}
