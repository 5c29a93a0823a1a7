# SPDX-License-Identifier: MIT
"""Small data sets in their true layouts and formats, written without the readers under test (used by test_data*.py)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

HEIGHT, WIDTH = 12, 20


class Tree:
    """Writes random content into files and remembers it."""

    def __init__(self, root: Path) -> None:
        self.root, self.random = root, np.random.default_rng(0)
        self.images: dict[str, np.ndarray] = {}
        self.flows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.masks: dict[str, np.ndarray] = {}

    def path(self, name: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def frames(self, *names: str) -> None:
        for name in names:
            self.images[name] = image = self.random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            Image.fromarray(image).save(self.path(name))

    def mask(self, *names: str) -> None:
        for name in names:
            self.masks[name] = mask = self.random.random((HEIGHT, WIDTH)) < 0.3
            Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(self.path(name))

    def flow(self, *names: str, sparse: bool = False) -> None:
        """In the format of the ending: .flo, .pfm, .png (KITTI, always sparse), .flo5."""
        for name in names:
            values = (self.random.integers(-640, 640, (HEIGHT, WIDTH, 2)) / 64).astype(np.float32)
            valid = np.ones((HEIGHT, WIDTH), bool)
            if sparse or name.endswith((".png", ".flo5")):
                valid = self.random.random((HEIGHT, WIDTH)) < 0.6
            self.flows[name] = np.where(valid[..., None], values, 0).astype(np.float32), valid
            self._writers()[Path(name).suffix](self.path(name), values, valid)

    def _writers(self) -> dict[str, Callable[[Path, np.ndarray, np.ndarray], None]]:
        return {".flo": write_flo, ".pfm": write_pfm, ".png": write_kitti, ".flo5": write_flo5}


def write_flo(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    stored = np.where(valid[..., None], flow, np.float32(1.666666752e9)).astype("<f4")
    path.write_bytes(b"PIEH" + struct.pack("<ii", flow.shape[1], flow.shape[0]) + stored.tobytes())


def write_pfm(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    colour = np.concatenate([flow, np.zeros((*valid.shape, 1))], axis=2).astype("<f4")
    path.write_bytes(b"PF\n%d %d\n-1.0\n" % valid.shape[::-1] + colour[::-1].tobytes())


def write_kitti(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    encoded = np.where(valid[..., None], np.dstack([flow * 64 + 32768, valid]), 0).round().astype(">u2")
    lines = b"".join(b"\0" + line.tobytes() for line in encoded)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", valid.shape[1], valid.shape[0], 16, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")
    )


def write_flo5(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    """Twice the frames' size; what lies between the samples must not be looked at."""
    h5py = pytest.importorskip("h5py")
    stored = np.full((2 * HEIGHT, 2 * WIDTH, 2), 77, np.float32)
    stored[::2, ::2] = np.where(valid[..., None], flow, np.nan)
    with h5py.File(path, "w") as file:
        file.create_dataset("flow", data=stored, compression="gzip")


def chairs2(t: Tree, train: tuple[str, ...] = ("0000000", "0000003"), val: tuple[str, ...] = ("0000001",)) -> None:
    for split, numbers in (("train", train), ("val", val)):
        for n in numbers:
            t.frames(f"{split}/{n}-img_0.png", f"{split}/{n}-img_1.png")
            t.flow(f"{split}/{n}-flow_01.flo", f"{split}/{n}-flow_10.flo")
    t.mask(*(f"train/0000000-{kind}_{way}.png" for kind in ("occ", "mb") for way in ("01", "10")))


def chairs(t: Tree) -> None:
    for n in ("00001", "00002", "00003"):
        t.frames(f"FlyingChairs_release/data/{n}_img1.ppm", f"FlyingChairs_release/data/{n}_img2.ppm")
        t.flow(f"FlyingChairs_release/data/{n}_flow.flo")
    t.path("FlyingChairs_release/FlyingChairs_train_val.txt").write_text("1\n2\n1\n")


def things(t: Tree) -> None:
    for scene in ("TRAIN/A/0000", "TRAIN/B/0011", "TEST/A/0000"):
        for side, letter in (("left", "L"), ("right", "R")):
            for frame in (6, 7, 8):
                for one_pass in ("clean", "final"):
                    t.frames(f"frames_{one_pass}pass/{scene}/{side}/{frame:04d}.png")
                for way in ("Future", "Past"):  # also where there is no next frame, as published
                    name = (
                        f"optical_flow/{scene}/into_{way.lower()}/{side}/OpticalFlowInto{way}_{frame:04d}_{letter}.pfm"
                    )
                    t.flow(name)
    t.mask("motion_boundaries/TRAIN/A/0000/into_future/left/0006.png")


def things_subset(t: Tree) -> None:
    for split in ("train", "val"):
        for n in (0, 1, 2, 10, 11):  # two scenes
            t.frames(f"{split}/image_clean/left/{n:07d}.png")
        for n in (0, 1, 10):
            t.flow(f"{split}/flow/left/into_future/{n:07d}.flo", f"{split}/flow/left/into_past/{n + 1:07d}.flo")
            t.mask(f"{split}/flow_occlusions/left/into_future/{n:07d}.png")


def sintel(t: Tree) -> None:
    for scene, count in (("alley_1", 3), ("market_5", 2)):
        for n in range(1, count + 1):
            t.frames(f"training/clean/{scene}/frame_{n:04d}.png", f"training/final/{scene}/frame_{n:04d}.png")
            t.mask(f"training/invalid/{scene}/frame_{n:04d}.png")
            if n < count:
                t.flow(f"training/flow/{scene}/frame_{n:04d}.flo")
                t.mask(f"training/occlusions/{scene}/frame_{n:04d}.png")
    t.frames("test/clean/cave_3/frame_0001.png", "test/clean/cave_3/frame_0002.png")


def kitti(images: str) -> Callable[[Tree], None]:
    def write(t: Tree) -> None:
        for n in ("000000", "000007"):
            t.frames(f"training/{images}/{n}_10.png", f"training/{images}/{n}_11.png", f"testing/{images}/{n}_10.png")
            t.frames(f"testing/{images}/{n}_11.png")
            t.flow(f"training/flow_occ/{n}_10.png")
            flow, valid = t.flows[f"training/flow_occ/{n}_10.png"]
            visible = valid & (t.random.random(valid.shape) < 0.8)
            t.flows[f"training/flow_noc/{n}_10.png"] = np.where(visible[..., None], flow, 0), visible
            write_kitti(t.path(f"training/flow_noc/{n}_10.png"), flow, visible)

    return write


def hd1k(t: Tree) -> None:
    for name in ("000000_0010", "000000_0011", "000000_0012", "000005_0000", "000005_0001"):
        t.frames(f"hd1k_input/image_2/{name}.png")
        t.flow(f"hd1k_flow_gt/flow_occ/{name}.png")
    t.frames("hd1k_challenge/image_2/000001_0000.png", "hd1k_challenge/image_2/000001_0001.png")


def middlebury(t: Tree) -> None:
    for scene in ("RubberWhale", "Venus", "Walking"):
        t.frames(f"other-data/{scene}/frame10.png", f"other-data/{scene}/frame11.png")
    t.flow("other-gt-flow/RubberWhale/flow10.flo", "other-gt-flow/Venus/flow10.flo", sparse=True)
    t.frames("eval-data/Army/frame10.png", "eval-data/Army/frame11.png")


def spring(t: Tree) -> None:
    for scene, count in (("0001", 3), ("0047", 2)):
        for side in ("left", "right"):
            t.frames(*(f"spring/train/{scene}/frame_{side}/frame_{side}_{n:04d}.png" for n in range(1, count + 1)))
            for n in range(1, count):
                t.flow(f"spring/train/{scene}/flow_FW_{side}/flow_FW_{side}_{n:04d}.flo5")
                t.flow(f"spring/train/{scene}/flow_BW_{side}/flow_BW_{side}_{n + 1:04d}.flo5")
    t.frames("spring/test/0003/frame_left/frame_left_0001.png", "spring/test/0003/frame_left/frame_left_0002.png")


TREES: dict[str, Callable[[Tree], None]] = {
    "chairs": chairs,
    "chairs2": chairs2,
    "things3d": things,
    "sintel": sintel,
    "kitti2012": kitti("colored_0"),
    "kitti2015": kitti("image_2"),
    "hd1k": hd1k,
    "middlebury": middlebury,
    "spring": spring,
}


def make(name: str, root: Path) -> Tree:
    tree = Tree(root)
    TREES[name](tree)
    return tree
