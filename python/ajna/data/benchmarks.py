# SPDX-License-Identifier: MIT
"""Sets that flow methods are compared on: MPI Sintel, Middlebury, Spring."""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna.data.files import (
    FilesDataset,
    Listing,
    Sample,
    TruthFiles,
    check_choice,
    find_root,
    missing,
    read_dense_flo,
    read_sparse_flo,
)

SINTEL_TREE = """\
  ROOT/training/clean/alley_1/frame_0001.png
  ROOT/training/final/alley_1/frame_0001.png
  ROOT/training/flow/alley_1/frame_0001.flo
  ROOT/training/occlusions/alley_1/frame_0001.png   (optional)
  ROOT/training/invalid/alley_1/frame_0001.png      (optional)
  ROOT/test/clean/...                               (for split=test)"""

MIDDLEBURY_TREE = """\
  ROOT/other-data/RubberWhale/frame10.png
  ROOT/other-data/RubberWhale/frame11.png
  ROOT/other-gt-flow/RubberWhale/flow10.flo
  ROOT/eval-data/Army/frame10.png, frame11.png   (for split=eval)"""

SPRING_TREE = """\
  ROOT/train/0001/frame_left/frame_left_0001.png
  ROOT/train/0001/flow_FW_left/flow_FW_left_0001.flo5
  ROOT/train/0001/flow_BW_left/flow_BW_left_0002.flo5   (for direction=BW)
  ROOT/test/0003/frame_left/...                         (for split=test)"""


class Sintel(FilesDataset):
    """MPI Sintel: 1041 training pairs of an animated film, 1024x436, dense ground truth.

    Args:
        root: the folder with `training/` and `test/` (or the one above its `MPI-Sintel-complete/`).
        split: training, or test (frames only).
        pass_name: clean, final (with blur and haze), or both.
        cases, skip_bad, max_flow: see FlowDataset. Cases are named clean/alley_1/frame_0001, ...

    Raises:
        FileNotFoundError: a folder or file is missing.
    """

    title = "MPI Sintel"

    def __init__(
        self,
        root: str | Path,
        split: str = "training",
        pass_name: str = "clean",
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("training", "test"))
        check_choice("pass_name", pass_name, ("clean", "final", "both"))
        passes = ("clean", "final") if pass_name == "both" else (pass_name,)
        needed = [f"{split}/{name}" for name in passes] + (["training/flow"] if split == "training" else [])
        base = find_root(self.title, root, ("MPI-Sintel-complete", "MPI-Sintel", "Sintel"), needed, SINTEL_TREE) / split
        listing = Listing()
        samples = {}
        for one_pass in passes:
            for scene in sorted(path for path in (base / one_pass).iterdir() if path.is_dir()):
                for start, end in _successive(listing, scene, r"frame_(\d{4})\.png"):
                    name = Path(scene.name) / f"frame_{start:04d}.png"
                    truth = None
                    if split == "training":
                        truth = TruthFiles(
                            (base / "flow" / name).with_suffix(".flo"),
                            read_dense_flo,
                            listing.optional(base / "occlusions" / name),
                            invalid=listing.optional(base / "invalid" / name),
                        )
                    samples[f"{one_pass}/{name.with_suffix('')}"] = Sample(
                        scene / name.name, scene / f"frame_{end:04d}.png", truth
                    )
        if not samples:
            raise missing(
                self.title, f"folder '{base / passes[0]}' holds no scene with two successive frames", SINTEL_TREE
            )
        super().__init__(root, samples, cases, skip_bad, max_flow)


class Middlebury(FilesDataset):
    """Middlebury: 8 pairs with ground truth (`other`), of 420x380 to 640x480.

    Args:
        root: the folder with `other-data/` and `other-gt-flow/`.
        split: other, or eval (frames only).
        cases, skip_bad, max_flow: see FlowDataset. Cases are named as their scene. Scenes without ground truth
            (`Beanbags`, `DogDance`, `MiniCooper`, `Walking`) are left out of `other`.

    Raises:
        FileNotFoundError: a folder or file is missing.
    """

    title = "Middlebury"

    def __init__(
        self,
        root: str | Path,
        split: str = "other",
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("other", "eval"))
        needed = [f"{split}-data", *(["other-gt-flow"] if split == "other" else [])]
        base = find_root(self.title, root, ("middlebury", "Middlebury"), needed, MIDDLEBURY_TREE)
        scenes = base / ("other-gt-flow" if split == "other" else "eval-data")
        samples = {}
        for scene in sorted(path.name for path in scenes.iterdir() if path.is_dir()):
            frames = base / f"{split}-data" / scene
            truth = None
            if split == "other":
                truth = TruthFiles(scenes / scene / "flow10.flo", read_sparse_flo)
            samples[scene] = Sample(frames / "frame10.png", frames / "frame11.png", truth)
        if not samples:
            raise missing(self.title, f"folder '{scenes}' holds no scene", MIDDLEBURY_TREE)
        super().__init__(root, samples, cases, skip_bad, max_flow)


class Spring(FilesDataset):
    """Spring: 5000 frames of an animated film, 1920x1080; its ground truth has twice that size.

    The ground truth is read at the frames' size by taking every second value along both axes, as the authors do; sky
    and other pixels without motion are NaN in the files and count as not valid. Needs h5py: pip install h5py.

    Args:
        root: the folder with `train/` and `test/` (or the one above its `spring/`).
        split: train, or test (frames only).
        camera: left, right, or both.
        direction: FW (forward), BW (backward), or both.
        backward: also give the ground truth of the other direction, as `FramePair.backward`.
        cases, skip_bad, max_flow: see FlowDataset. Cases are named 0001/left/0001/FW, ...

    Raises:
        FileNotFoundError: a folder or file is missing.
        RuntimeError: h5py is not installed (for the split with ground truth).
    """

    title = "Spring"

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        camera: str = "left",
        direction: str = "FW",
        backward: bool = False,
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("train", "test"))
        check_choice("camera", camera, ("left", "right", "both"))
        check_choice("direction", direction, ("FW", "BW", "both"))
        if split == "train":
            _h5py()
        base = find_root(self.title, root, ("spring", "Spring"), (split,), SPRING_TREE) / split
        listing = Listing()
        samples = {}
        for scene in sorted(path for path in base.iterdir() if path.is_dir()):
            for side in ("left", "right") if camera == "both" else (camera,):
                frames = scene / f"frame_{side}"
                steps = _successive(listing, frames, rf"frame_{side}_(\d{{4}})\.png")
                for way in ("FW", "BW") if direction == "both" else (direction,):
                    for pair in steps:
                        start, end = pair if way == "FW" else pair[::-1]
                        truth = _spring_truth(scene, side, way, start) if split == "train" else None
                        other = _spring_truth(scene, side, "BW" if way == "FW" else "FW", end)
                        samples[f"{scene.name}/{side}/{start:04d}/{way}"] = Sample(
                            frames / f"frame_{side}_{start:04d}.png",
                            frames / f"frame_{side}_{end:04d}.png",
                            truth,
                            other if backward and split == "train" else None,
                        )
        if not samples:
            raise missing(
                self.title,
                f"folder '{base}' holds no scene with two successive frames of the {camera} camera",
                SPRING_TREE,
            )
        super().__init__(root, samples, cases, skip_bad, max_flow)


def _spring_truth(scene: Path, side: str, way: str, frame: int) -> TruthFiles:
    kind = f"flow_{way}_{side}"
    return TruthFiles(scene / kind / f"{kind}_{frame:04d}.flo5", read_flo5)


def _successive(listing: Listing, folder: Path, pattern: str) -> list[tuple[int, int]]:
    """The numbers of neighbouring frames that both exist."""
    found = {int(match[1]) for name in listing.names(folder) if (match := re.fullmatch(pattern, name))}
    return [(number, number + 1) for number in sorted(found) if number + 1 in found]


def _h5py() -> Any:
    try:
        return importlib.import_module("h5py")
    except ImportError:
        raise RuntimeError("Spring's .flo5 files need the package h5py: pip install h5py") from None


def read_flo5(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Spring's HDF5 flow, every second value of both axes; NaN means unknown.

    Raises:
        ValueError: not an HDF5 file, or without a data set `flow` [2 H, 2 W, 2] of floats.
        RuntimeError: h5py is not installed.
    """
    h5py = _h5py()
    if not path.is_file():
        raise FileNotFoundError(f"file '{path}' does not exist; get a complete copy.")
    try:
        with h5py.File(path, "r") as file:
            if "flow" not in file:
                raise ValueError(f"file '{path}' holds no data set 'flow'; give one of Spring's .flo5 files.")
            flow = np.asarray(file["flow"])
    except OSError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"file '{path}' is not a whole HDF5 file ({reason}); get a good copy.") from error
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.dtype.kind != "f":
        held = f"{flow.dtype} {list(flow.shape)}"
        raise ValueError(f"file '{path}' holds {held}, not flow [H, W, 2] of floats; get a good copy.")
    flow = np.ascontiguousarray(flow[::2, ::2], dtype=np.float32)
    valid = np.isfinite(flow).all(axis=-1)
    return np.where(valid[..., None], flow, np.float32(0)), valid
