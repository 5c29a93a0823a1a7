# SPDX-License-Identifier: MIT
"""PairsDataset on small trees written in the true formats, byte by byte, without the readers under test."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna.data.pairs import FramePair, PairsDataset, resize_area

HEIGHT, WIDTH = 12, 20


def write_png(path: Path, array: np.ndarray) -> None:
    """A plain PNG: grey or RGB, 8 or 16 bits."""
    height, width = array.shape[:2]
    channels = 1 if array.ndim == 2 else array.shape[2]
    big_endian = array.astype(">u2" if array.dtype == np.uint16 else "u1")
    lines = b"".join(b"\0" + big_endian[y].tobytes() for y in range(height))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8 * array.dtype.itemsize, {1: 0, 3: 2}[channels], 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def write_ppm(path: Path, array: np.ndarray) -> None:
    path.write_bytes(b"P6\n%d %d\n255\n" % (array.shape[1], array.shape[0]) + array.tobytes())


def write_flo(path: Path, flow: np.ndarray) -> None:
    path.write_bytes(struct.pack("<fii", 202021.25, flow.shape[1], flow.shape[0]) + flow.astype("<f4").tobytes())


def write_kitti(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    encoded = np.concatenate([flow * 64 + 32768, valid[..., None]], axis=2)
    write_png(path, np.where(valid[..., None], encoded, 0).round().astype(np.uint16))


@pytest.fixture
def tree(tmp_path: Path) -> dict:
    """Three cases: Middlebury with all masks, KITTI sparse, and frames alone; plus what must be ignored."""
    random = np.random.default_rng(0)
    frames = [random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(2)]
    flow = (random.integers(-640, 640, (HEIGHT, WIDTH, 2)) / 64).astype(np.float32)
    valid = random.random((HEIGHT, WIDTH)) < 0.6
    occluded, invalid = random.random((2, HEIGHT, WIDTH)) < 0.2
    root = tmp_path / "pairs"
    for case in ("a_middlebury", "b_kitti", "c_plain", "notes", ".hidden"):
        (root / case).mkdir(parents=True)
    for number, frame in enumerate(frames, 1):
        write_png(root / f"a_middlebury/img{number}.png", frame)
        write_png(root / f"b_kitti/frame{number}.png", frame)
        write_ppm(root / f"c_plain/img{number}.ppm", frame)
    write_flo(root / "a_middlebury/flow.flo", np.where(valid[..., None], flow, 1.666e9))
    write_png(root / "a_middlebury/occ.png", np.where(occluded, 255, 0).astype(np.uint8))
    write_png(root / "a_middlebury/invalid.png", np.where(invalid, 255, 0).astype(np.uint8))
    write_kitti(root / "b_kitti/flow.png", flow, valid)
    (root / "README.txt").write_text("not a case")
    return {
        "root": root,
        "frames": frames,
        "flow": flow,
        "valid": valid,
        "occluded": occluded,
        "invalid": invalid,
    }


def test_reads_every_format(tree: dict) -> None:
    dataset = PairsDataset(tree["root"])
    assert dataset.names == ("a_middlebury", "b_kitti", "c_plain") and len(dataset) == 3
    middlebury, kitti, plain = (dataset[index] for index in range(3))
    for pair in (middlebury, kitti, plain):
        assert np.array_equal(pair.frame1, tree["frames"][0]) and np.array_equal(pair.frame2, tree["frames"][1])
        assert pair.size == (WIDTH, HEIGHT)
    expected = tree["valid"] & ~tree["invalid"]
    assert np.array_equal(middlebury.valid, expected) and np.array_equal(middlebury.occlusion, tree["occluded"])
    assert np.array_equal(middlebury.flow, np.where(expected[..., None], tree["flow"], 0))
    assert np.array_equal(kitti.valid, tree["valid"]) and kitti.occlusion is None
    assert np.array_equal(kitti.flow, np.where(tree["valid"][..., None], tree["flow"], 0))
    assert middlebury.flow.dtype == np.float32 and middlebury.valid.dtype == bool
    assert plain.flow is None and plain.valid is None and plain.occlusion is None


def test_cases_are_chosen_in_order_and_unknown_ones_named(tree: dict) -> None:
    assert PairsDataset(tree["root"], ["c_plain", "a_middlebury"]).names == ("c_plain", "a_middlebury")
    with pytest.raises(ValueError, match="'b_kiti' is not a case of .*did you mean 'b_kitti'"):
        PairsDataset(tree["root"], ["b_kiti"])
    with pytest.raises(ValueError, match="'zzz' is not a case of .*known are a_middlebury, b_kitti, c_plain"):
        PairsDataset(tree["root"], ["zzz"])


def test_wrong_roots_say_what_is_missing_and_how_the_tree_should_look(tree: dict, tmp_path: Path) -> None:
    layout = "expected ROOT/CASE/img1.png and img2.png"
    with pytest.raises(FileNotFoundError, match=f"nowhere' does not exist; {layout}"):
        PairsDataset(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=f"README.txt' is not a folder; {layout}"):
        PairsDataset(tree["root"] / "README.txt")
    with pytest.raises(FileNotFoundError, match="holds frames itself; pass the folder above it, .*pairs'"):
        PairsDataset(tree["root"] / "a_middlebury")
    with pytest.raises(FileNotFoundError, match=r"holds no frame pairs \(no folders\)"):
        PairsDataset(tree["root"] / "notes")
    with pytest.raises(FileNotFoundError, match=r"holds no frame pairs \(1 folders without frames\)"):
        PairsDataset(tmp_path)


def test_incomplete_cases_are_named(tree: dict) -> None:
    (tree["root"] / "a_middlebury/img2.png").unlink()
    with pytest.raises(FileNotFoundError, match="case 'a_middlebury' in .* lacks img2; expected"):
        PairsDataset(tree["root"])
    (tree["root"] / "a_middlebury/img1.png").unlink()
    with pytest.raises(FileNotFoundError, match="case 'a_middlebury' in .* lacks img1 and img2"):
        PairsDataset(tree["root"])


def test_two_ground_truths_are_refused(tree: dict) -> None:
    write_flo(tree["root"] / "b_kitti/flow.flo", tree["flow"])
    with pytest.raises(ValueError, match=r"case 'b_kitti' in .* has both flow.flo and flow.png"):
        PairsDataset(tree["root"])


@pytest.mark.parametrize("part", ["img2.png", "flow.flo", "occ.png", "invalid.png"])
def test_unequal_sizes_are_named(tree: dict, part: str) -> None:
    path = tree["root"] / "a_middlebury" / part
    if part == "flow.flo":
        write_flo(path, tree["flow"][:-1])
    else:
        write_png(path, np.zeros((HEIGHT - 1, WIDTH, 3), np.uint8))
    with pytest.raises(ValueError, match=f"case 'a_middlebury': {part} is 20x11, but img1.png is 20x12"):
        PairsDataset(tree["root"])[0]


def test_damaged_files_are_refused(tree: dict) -> None:
    path = tree["root"] / "a_middlebury/flow.flo"
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ValueError, match="flow.flo"):
        PairsDataset(tree["root"])[0]


# --- resizing ------------------------------------------------------------------------------------------------------


def test_resizing_scales_vectors_and_keeps_masks_with_them() -> None:
    random = np.random.default_rng(1)
    frame = random.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    valid = random.random((40, 60)) < 0.3
    flow = np.where(valid[..., None], random.normal(0, 9, (40, 60, 2)), 0).astype(np.float32)
    pair = FramePair("x", frame, frame, flow, valid, valid.copy()).resized(20, 10)
    assert pair.size == (20, 10) and pair.name == "x"
    # 3 x 4 pixels become one: its centre lies in the middle pixel of 3 columns, in the third of 4 rows.
    assert np.array_equal(pair.valid, valid[2::4, 1::3]) and np.array_equal(pair.occlusion, pair.valid)
    assert np.allclose(pair.flow, flow[2::4, 1::3] * np.float32([1 / 3, 1 / 4]))
    assert (pair.flow[~pair.valid] == 0).all() and pair.flow.dtype == np.float32
    blocks = frame.reshape(10, 4, 20, 3, 3).mean(axis=(1, 3))
    assert np.abs(pair.frame1 - blocks).max() <= 0.5


def test_resizing_to_the_same_size_changes_nothing_and_absent_parts_stay_absent() -> None:
    frame = np.zeros((4, 6, 3), np.uint8)
    pair = FramePair("x", frame, frame)
    assert pair.resized(6, 4) is pair
    smaller = pair.resized(3, 2)
    assert smaller.flow is smaller.valid is smaller.occlusion is None
    with pytest.raises(ValueError, match="size 0x4"):
        pair.resized(0, 4)


@pytest.mark.parametrize("size", [(7, 5), (13, 30), (60, 11), (60, 40), (61, 41), (200, 100), (1, 1)])
def test_area_resizing_keeps_constants_ramps_and_the_mean(size: tuple[int, int]) -> None:
    width, height = size
    constant = np.full((40, 60, 3), 77, np.uint8)
    assert (resize_area(constant, width, height) == 77).all()
    ramp = np.broadcast_to(np.arange(60, dtype=np.uint8)[None, :, None] * 4, (40, 60, 3))
    resized = resize_area(ramp, width, height)
    assert resized.shape == (height, width, 3)
    assert abs(resized.mean() - ramp.mean()) < 1
    assert (np.diff(resized[0, :, 0].astype(int)) >= 0).all()


@pytest.mark.parametrize("size", [(320, 240), (100, 77), (333, 290)])
def test_area_resizing_equals_opencv(size: tuple[int, int]) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs opencv-python-headless")
    image = np.random.default_rng(2).integers(0, 256, (300, 350, 3), dtype=np.uint8)
    expected = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    assert np.abs(resize_area(image, *size).astype(int) - expected).max() <= 1
