# SPDX-License-Identifier: MIT
"""A folder of frame pairs with (optional) ground truth: the data set that `ajna evaluate` scores."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from ajna import io

FRAME_SUFFIXES = (".png", ".ppm", ".jpg", ".jpeg", ".bmp", ".pgm")
FRAME_STEMS = {"frame1": ("img1", "frame1"), "frame2": ("img2", "frame2")}

LAYOUT = (
    "expected ROOT/CASE/img1.png and img2.png (also frame1/frame2, .ppm, .jpg, .bmp), optionally beside them flow.flo "
    "or KITTI's flow.png (ground truth), occ.png (white: hidden in frame 2), invalid.png (white: not scored)"
)


@dataclass(frozen=True)
class FramePair:
    """One pair. Arrays are on frame 1's grid; what the data set does not have is None.

    Attributes:
        name: the case's folder name.
        frame1, frame2: RGB uint8 [H, W, 3].
        flow: ground truth float32 [H, W, 2], pixels, 0 where not valid.
        valid: bool [H, W], where the ground truth is known and may be scored; None exactly where `flow` is.
        occlusion: bool [H, W], visible in frame 1 and hidden in, or outside, frame 2.
    """

    name: str
    frame1: NDArray[np.uint8]
    frame2: NDArray[np.uint8]
    flow: NDArray[np.float32] | None = None
    valid: NDArray[np.bool_] | None = None
    occlusion: NDArray[np.bool_] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.frame1.shape[1], self.frame1.shape[0]

    def resized(self, width: int, height: int) -> FramePair:
        """The pair at another size: frames by area, ground truth and masks by the nearest pixel, vectors scaled.

        Nearest, because ground truth may be sparse and flow edges are real: an average over a motion boundary would be
        a motion that no point has. u is scaled by width / W, v by height / H.
        """
        if width < 1 or height < 1:
            raise ValueError(f"size {width}x{height} is not a picture; both sides must be at least 1 pixel.")
        if (width, height) == self.size:
            return self
        old_width, old_height = self.size
        rows, columns = _nearest(old_height, height), _nearest(old_width, width)

        def pick(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[rows][:, columns]

        scale = np.array([width / old_width, height / old_height], dtype=np.float32)
        flow = pick(self.flow)
        return FramePair(
            self.name,
            resize_area(self.frame1, width, height),
            resize_area(self.frame2, width, height),
            None if flow is None else flow * scale,
            pick(self.valid),
            pick(self.occlusion),
        )


def _nearest(old: int, new: int) -> NDArray[np.intp]:
    """For each of `new` samples the old pixel that holds its centre."""
    return np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.intp), old - 1)


def _resampling(old: int, new: int) -> NDArray[np.float64]:
    """Weights [new, old], rows summing to 1: area overlap when shrinking, linear interpolation when enlarging."""
    if new <= old:
        edges = np.arange(new + 1) * old / new
        pixel = np.arange(old)
        overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
        return np.clip(overlap, 0.0, None) * new / old
    centre = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
    lower = np.minimum(centre.astype(np.intp), max(old - 2, 0))
    weights = np.zeros((new, old))
    np.add.at(weights, (np.arange(new), lower), 1.0 - (centre - lower))
    np.add.at(weights, (np.arange(new), np.minimum(lower + 1, old - 1)), centre - lower)
    return weights


def resize_area(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Resize an image uint8 [H, W, C]: each new pixel is the mean over its area (linear interpolation to enlarge)."""
    rows = _resampling(image.shape[0], height) @ image.reshape(image.shape[0], -1).astype(np.float64)
    rows = rows.reshape(height, image.shape[1], image.shape[2])
    resized = np.matmul(_resampling(image.shape[1], width), rows)
    return np.clip(np.rint(resized), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class _CaseFiles:
    frame1: Path
    frame2: Path
    flow: Path | None
    occlusion: Path | None
    invalid: Path | None


class PairsDataset(Dataset[FramePair]):
    """Frame pairs under a folder, in order of name; items are read when asked for::

        ROOT/
          any_case_name/
            img1.png, img2.png      the frames (also frame1/frame2; .ppm, .jpg, .bmp)
            flow.flo or flow.png    optional ground truth: Middlebury .flo or KITTI's 16-bit png
            occ.png                 optional: white where a pixel of frame 1 is hidden in frame 2
            invalid.png             optional: white where the ground truth must not be scored

    Args:
        root: the folder that holds one folder per pair.
        cases: only these (and in this order); by default all.

    Raises:
        FileNotFoundError: `root` is missing, holds no pair, or a pair lacks a frame; says what is expected where.
        ValueError: an unknown name in `cases`, two ground truths in one folder, or (when an item is
            read) parts whose sizes differ.
    """

    def __init__(self, root: str | Path, cases: Sequence[str] = ()) -> None:
        self.root = Path(root)
        files = _find_cases(self.root)
        check_names(cases, files, self.root)
        self._files = {name: files[name] for name in cases or files}
        self.names: tuple[str, ...] = tuple(self._files)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> FramePair:
        name = self.names[index]
        files = self._files[name]
        frame1, frame2 = io.read_image(files.frame1), io.read_image(files.frame2)
        parts: dict[str, NDArray[Any]] = {files.frame2.name: frame2}
        flow = valid = occlusion = None
        if files.flow is not None:
            flow, valid = _read_flow(files.flow)
            parts[files.flow.name] = valid
        if files.invalid is not None:
            parts[files.invalid.name] = invalid = _read_mask(files.invalid)
        if files.occlusion is not None:
            parts[files.occlusion.name] = occlusion = _read_mask(files.occlusion)
        for part, array in parts.items():
            if array.shape[:2] != frame1.shape[:2]:
                raise ValueError(
                    f"case '{name}': {part} is {array.shape[1]}x{array.shape[0]}, but {files.frame1.name} is "
                    f"{frame1.shape[1]}x{frame1.shape[0]}; all parts of a case must have one size."
                )
        if flow is not None and valid is not None:
            valid = valid & ~invalid if files.invalid is not None else valid
            flow = np.where(valid[..., None], flow, np.float32(0))
        return FramePair(name, frame1, frame2, flow, valid, occlusion)


def check_names(names: Iterable[str], known: Iterable[str], root: str | Path) -> None:
    """Raise ValueError, with the nearest or all known names, if one of `names` is not a case."""
    known = list(known)
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}."
            raise ValueError(f"'{name}' is not a case of '{root}'; {hint}")


def _find_cases(root: Path) -> dict[str, _CaseFiles]:
    if not root.is_dir():
        what = "is not a folder" if root.exists() else "does not exist"
        raise FileNotFoundError(f"data folder '{root}' {what}; {LAYOUT}.")
    if any(_frame(root, part) for part in FRAME_STEMS):
        raise FileNotFoundError(
            f"data folder '{root}' holds frames itself; pass the folder above it, '{root.absolute().parent}'; {LAYOUT}."
        )
    folders = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    candidates = [path for path in folders if _holds_a_part(path)]
    if not candidates:
        held = f"{len(folders)} folders without frames" if folders else "no folders"
        raise FileNotFoundError(f"data folder '{root}' holds no frame pairs ({held}); {LAYOUT}.")
    return {path.name: _case_files(path) for path in candidates}


def _frame(folder: Path, part: str) -> Path | None:
    names = (folder / f"{stem}{suffix}" for stem in FRAME_STEMS[part] for suffix in FRAME_SUFFIXES)
    return next((path for path in names if path.is_file()), None)


def _optional(folder: Path, name: str) -> Path | None:
    path = folder / name
    return path if path.is_file() else None


def _holds_a_part(folder: Path) -> bool:
    return any(_frame(folder, part) for part in FRAME_STEMS) or any(
        _optional(folder, name) for name in ("flow.flo", "flow.png", "occ.png")
    )


def _case_files(folder: Path) -> _CaseFiles:
    frames = {part: _frame(folder, part) for part in FRAME_STEMS}
    missing = [FRAME_STEMS[part][0] for part, path in frames.items() if path is None]
    if frames["frame1"] is None or frames["frame2"] is None:
        raise FileNotFoundError(f"case '{folder.name}' in '{folder.parent}' lacks {' and '.join(missing)}; {LAYOUT}.")
    truths = [path for name in ("flow.flo", "flow.png") if (path := _optional(folder, name)) is not None]
    if len(truths) > 1:
        raise ValueError(
            f"case '{folder.name}' in '{folder.parent}' has both flow.flo and flow.png; remove the one not to score."
        )
    return _CaseFiles(
        frames["frame1"],
        frames["frame2"],
        truths[0] if truths else None,
        _optional(folder, "occ.png"),
        _optional(folder, "invalid.png"),
    )


def _read_flow(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    if path.suffix == ".flo":
        flow = io.read_flo(path)
        return flow, io.known_flow(flow)
    return io.read_kitti_flow(path)


def _read_mask(path: Path) -> NDArray[np.bool_]:
    """White is true."""
    return io.read_image(path)[..., 0] >= 128
