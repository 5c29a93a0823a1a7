# SPDX-License-Identifier: MIT
"""A folder of frame pairs with (optional) ground truth: the simplest data set, for pairs of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ajna import io
from ajna.data.dataset import check_names
from ajna.data.files import FilesDataset, Sample, TruthFiles, read_sparse_flo
from ajna.data.frame_pair import FramePair, resize_area

__all__ = ["FramePair", "PairsDataset", "check_names", "resize_area"]

FRAME_SUFFIXES = (".png", ".ppm", ".jpg", ".jpeg", ".bmp", ".pgm")
FRAME_STEMS = {"frame1": ("img1", "frame1"), "frame2": ("img2", "frame2")}

LAYOUT = (
    "expected ROOT/CASE/img1.png and img2.png (also frame1/frame2, .ppm, .jpg, .bmp), optionally beside them flow.flo "
    "or KITTI's flow.png (ground truth), occ.png (white: hidden in frame 2), invalid.png (white: not scored)"
)


class PairsDataset(FilesDataset):
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
        skip_bad, max_flow: see FlowDataset.

    Raises:
        FileNotFoundError: `root` is missing, holds no pair, or a pair lacks a frame; says what is expected where.
        ValueError: an unknown name in `cases`, two ground truths in one folder, or (when an item is
            read) parts whose sizes differ.
    """

    title = "pairs"

    def __init__(
        self, root: str | Path, cases: Sequence[str] = (), skip_bad: bool = False, max_flow: float | None = None
    ) -> None:
        super().__init__(root, _find_cases(Path(root)), cases, skip_bad, max_flow)


def _find_cases(root: Path) -> dict[str, Sample]:
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
    return {path.name: _sample(path) for path in candidates}


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


def _sample(folder: Path) -> Sample:
    frames = {part: _frame(folder, part) for part in FRAME_STEMS}
    missing = [FRAME_STEMS[part][0] for part, path in frames.items() if path is None]
    if frames["frame1"] is None or frames["frame2"] is None:
        raise FileNotFoundError(f"case '{folder.name}' in '{folder.parent}' lacks {' and '.join(missing)}; {LAYOUT}.")
    truths = [path for name in ("flow.flo", "flow.png") if (path := _optional(folder, name)) is not None]
    if len(truths) > 1:
        raise ValueError(
            f"case '{folder.name}' in '{folder.parent}' has both flow.flo and flow.png; remove the one not to score."
        )
    occlusion, invalid = _optional(folder, "occ.png"), _optional(folder, "invalid.png")
    if not truths:
        return Sample(frames["frame1"], frames["frame2"], occlusion=occlusion)
    reader = read_sparse_flo if truths[0].suffix == ".flo" else io.read_kitti_flow
    truth = TruthFiles(truths[0], reader, occlusion, invalid=invalid)
    return Sample(frames["frame1"], frames["frame2"], truth)
