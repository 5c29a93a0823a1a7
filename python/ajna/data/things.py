# SPDX-License-Identifier: MIT
"""FlyingThings3D: rendered things on random 3-D tracks, seen by a moving stereo camera."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ajna.data.files import (
    FilesDataset,
    Listing,
    Sample,
    TruthFiles,
    check_choice,
    find_root,
    missing,
    read_dense_flo,
    read_dense_pfm,
)

FULL_TREE = """\
  ROOT/frames_cleanpass/TRAIN/A/0000/left/0006.png
  ROOT/frames_finalpass/TRAIN/A/0000/left/0006.png   (for pass_name=final)
  ROOT/optical_flow/TRAIN/A/0000/into_future/left/OpticalFlowIntoFuture_0006_L.pfm
  ROOT/optical_flow/TRAIN/A/0000/into_past/left/OpticalFlowIntoPast_0007_L.pfm
  ROOT/motion_boundaries/TRAIN/A/0000/into_future/left/0006.png   (optional)
  (TEST beside TRAIN, right beside left; or the subset layout)"""

SUBSET_TREE = """\
  ROOT/train/image_clean/left/0000000.png
  ROOT/train/image_final/left/0000000.png   (for pass_name=final)
  ROOT/train/flow/left/into_future/0000000.flo
  ROOT/train/flow/left/into_past/0000001.flo
  ROOT/train/flow_occlusions/left/into_future/0000000.png, motion_boundaries/...   (optional)
  (val beside train, right beside left)"""

NESTED = ("FlyingThings3D", "flyingthings3d", "FlyingThings3D_release", "FlyingThings3D_subset")
WAYS = {"future": 1, "past": -1}
BAD_LINE = re.compile(r"(TRAIN|TEST)/[ABC]/\d{4}/(left|right)/\d{4}\.png")


class FlyingThings3D(FilesDataset):
    """FlyingThings3D, 960x540, with flow into the future and the past, in either published layout.

    The layout is found out: the full set (`frames_cleanpass/`, `optical_flow/`, .pfm) or the subset that the authors
    trained on (`train/image_clean/`, `train/flow/`, .flo, occlusions).

    Args:
        root: the folder of either layout (or the one above it).
        split: train or test (the subset calls it val; both words are taken).
        pass_name: clean, final, or both.
        camera: left, right, or both.
        direction: future, past, or both.
        backward: also give the ground truth of the other direction, as `FramePair.backward`.
        bad_samples: list of frames not to use, one `TRAIN/A/0000/left/0006.png` a line, as published by the authors
            (all_unused_files.txt); a pair that holds such a frame is left out. For the full layout only.
        cases, skip_bad, max_flow: see FlowDataset. Some vectors are thousands of pixels long; max_flow=1000 is usual.
            Cases are named clean/A/0000/left/0006/future (full) or clean/left/0000006/future (subset).

    Raises:
        FileNotFoundError: a folder or file is missing.
        ValueError: a malformed list of bad samples, or one that leaves nothing.
    """

    title = "FlyingThings3D"

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        pass_name: str = "clean",
        camera: str = "left",
        direction: str = "future",
        backward: bool = False,
        bad_samples: str | Path | None = None,
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("train", "test", "val"))
        passes = _chosen("pass_name", pass_name, ("clean", "final"))
        cameras = _chosen("camera", camera, ("left", "right"))
        ways = _chosen("direction", direction, tuple(WAYS))
        split = "train" if split == "train" else "test"
        samples: dict[str, Sample] = {}
        if _is_subset(Path(root)):
            if bad_samples is not None:
                raise ValueError(
                    f"bad_samples '{bad_samples}' names frames of the full FlyingThings3D, but '{root}' is the subset, "
                    "which is already without them; leave the list out."
                )
            folder = "train" if split == "train" else "val"
            needed = (*(f"{folder}/image_{name}" for name in passes), f"{folder}/flow")
            base = find_root(self.title, root, NESTED, needed, SUBSET_TREE)
            for one_pass in passes:
                for side in cameras:
                    for way in ways:
                        samples |= _subset(base / folder, one_pass, side, way, backward)
        else:
            needed = (*(f"frames_{name}pass/{split.upper()}" for name in passes), f"optical_flow/{split.upper()}")
            base = find_root(self.title, root, NESTED, needed, FULL_TREE)
            unused = frozenset() if bad_samples is None else _read_bad_samples(Path(bad_samples))
            full = _FullLayout(base, split.upper(), unused, Listing())
            for one_pass in passes:
                for scene in _scenes(base / f"frames_{one_pass}pass" / split.upper()):
                    for side in cameras:
                        for way in ways:
                            samples |= full.pairs(one_pass, scene, side, way, backward)
            if not samples and unused:
                raise ValueError(f"bad_samples '{bad_samples}' leaves no pair of '{root}'; check the list.")
            if not samples:
                where = base / f"frames_{passes[0]}pass" / split.upper()
                raise missing(self.title, f"folder '{where}' holds no two successive frames", FULL_TREE)
        super().__init__(root, samples, cases, skip_bad, max_flow)


def _chosen(option: str, value: str, choices: tuple[str, ...]) -> tuple[str, ...]:
    check_choice(option, value, (*choices, "both"))
    return choices if value == "both" else (value,)


def _is_subset(root: Path) -> bool:
    """By what only one layout has; a root with neither is reported as the full layout."""
    folders = (root, *(root / name for name in NESTED))
    return any((folder / split / "flow").is_dir() for folder in folders for split in ("train", "val")) or any(
        (folder / split / "image_clean").is_dir() for folder in folders for split in ("train", "val")
    )


def _scenes(folder: Path) -> Iterator[Path]:
    """A/0000, A/0001, ..., relative to the folder."""
    for letter in sorted(path for path in folder.iterdir() if path.is_dir()):
        yield from (scene.relative_to(folder) for scene in sorted(letter.iterdir()) if scene.is_dir())


@dataclass(frozen=True)
class _FullLayout:
    base: Path
    split: str  # TRAIN or TEST
    unused: frozenset[str]  # frames not to use
    listing: Listing

    def pairs(self, one_pass: str, scene: Path, side: str, way: str, backward: bool) -> dict[str, Sample]:
        """The pairs of one camera of one scene: neighbouring frames that both exist."""
        folder = self.base / f"frames_{one_pass}pass" / self.split / scene / side
        numbers = sorted(int(name[:-4]) for name in self.listing.names(folder) if re.fullmatch(r"\d{4}\.png", name))
        usable = {n for n in numbers if f"{self.split}/{scene}/{side}/{n:04d}.png" not in self.unused}
        return {
            f"{one_pass}/{scene}/{side}/{start:04d}/{way}": Sample(
                folder / f"{start:04d}.png",
                folder / f"{end:04d}.png",
                self._truth(scene, side, way, start),
                self._truth(scene, side, _other(way), end) if backward else None,
            )
            for start in numbers
            if start in usable and (end := start + WAYS[way]) in usable
        }

    def _truth(self, scene: Path, side: str, way: str, start: int) -> TruthFiles:
        where = Path(self.split) / scene / f"into_{way}" / side
        name = f"OpticalFlowInto{way.capitalize()}_{start:04d}_{side[0].upper()}.pfm"
        boundary = self.listing.optional(self.base / "motion_boundaries" / where / f"{start:04d}.png")
        return TruthFiles(self.base / "optical_flow" / where / name, read_dense_pfm, motion_boundary=boundary)


def _subset(base: Path, one_pass: str, side: str, way: str, backward: bool) -> dict[str, Sample]:
    """The pairs of one camera of the subset: its flow files tell which frames follow each other."""
    listing = Listing()
    folder = base / "flow" / side / f"into_{way}"
    stems = sorted(name[:-4] for name in listing.names(folder) if re.fullmatch(r"\d{7}\.flo", name))
    if not stems:
        raise missing(FlyingThings3D.title, f"folder '{folder}' holds no 0000000.flo", SUBSET_TREE)

    def truth(start: int, way: str) -> TruthFiles:
        place = Path(side) / f"into_{way}" / f"{start:07d}"
        return TruthFiles(
            (base / "flow" / place).with_suffix(".flo"),
            read_dense_flo,
            listing.optional((base / "flow_occlusions" / place).with_suffix(".png")),
            listing.optional((base / "motion_boundaries" / place).with_suffix(".png")),
        )

    frames = base / f"image_{one_pass}" / side
    samples = {}
    for stem in stems:
        start, end = int(stem), int(stem) + WAYS[way]
        samples[f"{one_pass}/{side}/{stem}/{way}"] = Sample(
            frames / f"{start:07d}.png",
            frames / f"{end:07d}.png",
            truth(start, way),
            truth(end, _other(way)) if backward else None,
        )
    return samples


def _other(way: str) -> str:
    return "past" if way == "future" else "future"


def _read_bad_samples(path: Path) -> frozenset[str]:
    if not path.is_file():
        raise FileNotFoundError(f"list of bad samples '{path}' does not exist; give the authors' all_unused_files.txt.")
    lines = [line.strip() for line in path.read_text(errors="replace").splitlines() if line.strip()]
    strange = next((line for line in lines if BAD_LINE.fullmatch(line) is None), None)
    if strange is not None:
        raise ValueError(
            f"list of bad samples '{path}' has the line '{strange[:60]}'; "
            "each line must look like TRAIN/A/0000/left/0006.png."
        )
    return frozenset(lines)
