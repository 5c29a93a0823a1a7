# SPDX-License-Identifier: MIT
"""Data sets of image and flow files: reading a sample with checks, finding the folders, errors that show the tree."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import io
from ajna.data.dataset import FlowDataset, check_names, limited
from ajna.data.frame_pair import FramePair, Truth

FlowReader = Callable[[Path], tuple[NDArray[np.float32], NDArray[np.bool_]]]


@dataclass(frozen=True)
class TruthFiles:
    """The files of one direction's ground truth; `read` gives (flow, where it is known)."""

    flow: Path
    read: FlowReader
    occlusion: Path | None = None  # white: hidden in the other frame
    motion_boundary: Path | None = None  # white: the motion jumps
    invalid: Path | None = None  # white: do not score
    visible_flow: Path | None = None  # KITTI's flow of the pixels that stay visible: known minus these is occluded

    def paths(self) -> list[Path]:
        """All files."""
        optional = (self.occlusion, self.motion_boundary, self.invalid, self.visible_flow)
        return [self.flow, *(path for path in optional if path is not None)]


@dataclass(frozen=True)
class Sample:
    """The files of one pair. `occlusion` is for pairs that have the mask, but no flow."""

    frame1: Path
    frame2: Path
    truth: TruthFiles | None = None
    backward: TruthFiles | None = None
    occlusion: Path | None = None

    def paths(self) -> list[Path]:
        """All files, the frames first."""
        found = [self.frame1, self.frame2, *([] if self.occlusion is None else [self.occlusion])]
        for truth in (self.truth, self.backward):
            found += [] if truth is None else truth.paths()
        return found

    def parts(self) -> frozenset[str]:
        """What the pair has beyond its frames: flow, occlusion, motion_boundary, backward_flow, ..."""
        found = set()
        for prefix, truth in (("", self.truth), ("backward_", self.backward)):
            if truth is not None:
                found.add(f"{prefix}flow")
                if truth.occlusion is not None or truth.visible_flow is not None:
                    found.add(f"{prefix}occlusion")
                if truth.motion_boundary is not None:
                    found.add(f"{prefix}motion_boundary")
        return frozenset(found)


class FilesDataset(FlowDataset):
    """A data set whose samples are image and flow files.

    Args:
        samples: case -> its files.
        cases: only these (and in this order); by default all.
        root, skip_bad, max_flow: see FlowDataset.

    Raises:
        ValueError: an unknown name in `cases`.
        FileNotFoundError: a sample lacks a file (with `skip_bad` it is listed in `bad`).
    """

    def __init__(
        self,
        root: str | Path,
        samples: Mapping[str, Sample],
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_names(cases, samples, root)
        self._samples = {name: samples[name] for name in cases or samples}
        super().__init__(root, self._samples, skip_bad, max_flow)
        self._check_files()

    def _check_files(self) -> None:
        listing = Listing()
        for name, sample in self._samples.items():
            missing = next((path for path in sample.paths() if path not in listing), None)
            if missing is not None:
                reason = f"{self.title}: case '{name}' lacks '{missing}'; get a complete copy or skip bad samples."
                if not self.skip_bad:
                    raise FileNotFoundError(reason)
                self.bad[name] = reason

    def files(self, index: int) -> list[Path]:
        return self._samples[self.names[index]].paths()

    def parts(self, index: int) -> frozenset[str]:
        return self._samples[self.names[index]].parts()

    def read(self, index: int) -> FramePair:
        name = self.names[index]
        sample = self._samples[name]
        frame1, frame2 = io.read_image(sample.frame1), io.read_image(sample.frame2)
        check = _SizeCheck(name, sample.frame1, frame1)
        check(sample.frame2, frame2)
        occlusion = None if sample.occlusion is None else check(sample.occlusion, read_mask(sample.occlusion))
        truth = None if sample.truth is None else self._truth(sample.truth, check)
        backward = None if sample.backward is None else self._truth(sample.backward, check)
        if truth is None:
            return FramePair(name, frame1, frame2, occlusion=occlusion, backward=backward)
        return FramePair(
            name, frame1, frame2, truth.flow, truth.valid, truth.occlusion, truth.motion_boundary, backward
        )

    def _truth(self, files: TruthFiles, check: _SizeCheck) -> Truth:
        flow, valid = files.read(files.flow)
        check(files.flow, valid)

        def mask(path: Path | None) -> NDArray[np.bool_] | None:
            return None if path is None else check(path, read_mask(path))

        occlusion, boundary, invalid = mask(files.occlusion), mask(files.motion_boundary), mask(files.invalid)
        if files.visible_flow is not None:
            visible = check(files.visible_flow, files.read(files.visible_flow)[1])
            occlusion = valid & ~visible
        if invalid is not None:
            valid = valid & ~invalid
        return limited(Truth(flow, valid, occlusion, boundary), self.max_flow)


class _SizeCheck:
    def __init__(self, name: str, path: Path, frame: NDArray[Any]) -> None:
        self.name, self.path, self.shape = name, path, frame.shape[:2]

    def __call__(self, path: Path, array: NDArray[Any]) -> NDArray[Any]:
        if array.shape[:2] != self.shape:
            raise ValueError(
                f"case '{self.name}': {path.name} is {array.shape[1]}x{array.shape[0]}, but {self.path.name} is "
                f"{self.shape[1]}x{self.shape[0]}; all parts of a case must have one size ('{path}')."
            )
        return array


class Listing:
    """Which files exist, by listing each folder once: a set has a hundred thousand files, maybe over a network."""

    def __init__(self) -> None:
        self._folders: dict[Path, frozenset[str]] = {}

    def names(self, folder: Path) -> frozenset[str]:
        """The names in a folder; none if there is no such folder."""
        if folder not in self._folders:
            try:
                self._folders[folder] = frozenset(os.listdir(folder))
            except (FileNotFoundError, NotADirectoryError):
                self._folders[folder] = frozenset()
        return self._folders[folder]

    def __contains__(self, path: Path) -> bool:
        return path.name in self.names(path.parent)

    def optional(self, path: Path) -> Path | None:
        """The path if it exists."""
        return path if path in self else None


def check_choice(option: str, value: str, choices: Sequence[str]) -> str:
    """Raise ValueError unless an option has one of its values."""
    if value not in choices:
        raise ValueError(f"{option} '{value}' is unknown; give one of {', '.join(choices)}.")
    return value


def missing(title: str, what: str, tree: str) -> FileNotFoundError:
    """The error of a wrong root: what is missing, and how the tree should look."""
    return FileNotFoundError(f"{title}: {what}; the folders should look like this:\n{tree}")


def find_root(title: str, root: str | Path, nested: Sequence[str], needed: Sequence[str], tree: str) -> Path:
    """`root`, or the folder in it that the archive unpacks to, whichever holds all of `needed`.

    Raises:
        FileNotFoundError: there is no such folder: names it and shows the tree.
    """
    root = Path(root)
    if not root.is_dir():
        raise missing(title, f"folder '{root}' {'is a file' if root.exists() else 'does not exist'}", tree)
    for folder in (root, *(root / name for name in nested)):
        if all((folder / name).is_dir() for name in needed):
            return folder
    # Of several roots the one that has most: its gap is the one to close.
    best = max((root, *(root / name for name in nested)), key=lambda f: sum((f / name).is_dir() for name in needed))
    lacking = next(name for name in needed if not (best / name).is_dir())
    raise missing(title, f"folder '{best / lacking}' is missing", tree)


# --- readers -------------------------------------------------------------------------------------------------------


def read_mask(path: Path) -> NDArray[np.bool_]:
    """White is true."""
    return io.read_image(path)[..., 0] >= 128


def read_sparse_flo(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A .flo in which NaN and huge values mean unknown."""
    flow = io.read_flo(path)
    return flow, io.known_flow(flow)


def read_dense_flo(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A .flo of a rendered set: values that are not finite are damage; Middlebury's huge value still means unknown."""
    flow = io.read_flo(path)
    return check_finite(path, flow), io.known_flow(flow)


def read_dense_pfm(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """FlyingThings3D's flow: u and v in the first two of three channels."""
    image = io.read_pfm(path)
    if image.ndim != 3 or image.shape[2] < 2:
        raise ValueError(f"file '{path}' has one channel, so it holds no flow; give a colour PFM ('PF').")
    flow = check_finite(path, np.ascontiguousarray(image[..., :2]))
    return flow, io.known_flow(flow)


def check_finite(path: Path, flow: NDArray[np.float32]) -> NDArray[np.float32]:
    """Raise ValueError for NaN and infinities, saying how many and where the first is."""
    bad = ~np.isfinite(flow).all(axis=-1)
    if bad.any():
        y, x = (int(value) for value in np.argwhere(bad)[0])
        raise ValueError(
            f"flow file '{path}' is not finite at {int(bad.sum())} pixels (the first at x {x}, y {y}); "
            "get a good copy or skip bad samples."
        )
    return flow
