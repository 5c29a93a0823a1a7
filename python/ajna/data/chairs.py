# SPDX-License-Identifier: MIT
"""FlyingChairs and FlyingChairs2: rendered chairs before photographs, planar motion."""

from __future__ import annotations

from collections.abc import Sequence
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
)

CHAIRS_TREE = """\
  ROOT/data/00001_img1.ppm
  ROOT/data/00001_img2.ppm
  ROOT/data/00001_flow.flo
  ROOT/FlyingChairs_train_val.txt   (one line per pair: 1 for train, 2 for val)"""

CHAIRS2_TREE = """\
  ROOT/train/0000000-img_0.png
  ROOT/train/0000000-img_1.png
  ROOT/train/0000000-flow_01.flo
  ROOT/train/0000000-flow_10.flo   (backward; needed with backward=True or direction=backward/both)
  ROOT/train/0000000-occ_01.png, -occ_10.png, -mb_01.png, -mb_10.png   (optional)
  ROOT/val/...                     (the same)"""

SPLIT_FILE = "FlyingChairs_train_val.txt"
DIRECTIONS = ("forward", "backward", "both")


class FlyingChairs(FilesDataset):
    """FlyingChairs: 22872 pairs of 512x384 with forward flow.

    Args:
        root: the folder with `data/` (or the one above its `FlyingChairs_release/`).
        split: train, val, or all (which needs no split file).
        split_file: the list of the split; by default FlyingChairs_train_val.txt in the root or in `data/`.
        cases, skip_bad, max_flow: see FlowDataset. Cases are named 00001, 00002, ...

    Raises:
        FileNotFoundError: a folder or the split file is missing.
        ValueError: the split file has another number of lines than there are pairs, or other values than 1 and 2.
    """

    title = "FlyingChairs"

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        split_file: str | Path | None = None,
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("train", "val", "all"))
        base = find_root(self.title, root, ("FlyingChairs_release", "FlyingChairs"), ("data",), CHAIRS_TREE)
        folder = base / "data"
        # The pairs are counted by their flow, so that a lost frame is an error and not a shift of the split.
        stems = sorted(name[: -len("_flow.flo")] for name in Listing().names(folder) if name.endswith("_flow.flo"))
        if not stems:
            raise missing(self.title, f"folder '{folder}' holds no NUMBER_flow.flo", CHAIRS_TREE)
        if split != "all":
            wanted = {"train": "1", "val": "2"}[split]
            marks = _read_split(base, split_file, len(stems))
            stems = [stem for stem, mark in zip(stems, marks, strict=True) if mark == wanted]
            if not stems:
                raise ValueError(f"{self.title}: the split file puts no pair of '{base}' into '{split}'.")
        samples = {
            stem: Sample(
                folder / f"{stem}_img1.ppm",
                folder / f"{stem}_img2.ppm",
                TruthFiles(folder / f"{stem}_flow.flo", read_dense_flo),
            )
            for stem in stems
        }
        super().__init__(root, samples, cases, skip_bad, max_flow)


def _read_split(base: Path, split_file: str | Path | None, count: int) -> list[str]:
    places = [base / SPLIT_FILE, base / "data" / SPLIT_FILE] if split_file is None else [Path(split_file)]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise missing(
            FlyingChairs.title, f"split file '{places[0]}' is missing (or load split=all, without it)", CHAIRS_TREE
        )
    marks = path.read_text(errors="replace").split()
    strange = next((number for number, mark in enumerate(marks, 1) if mark not in ("1", "2")), None)
    if strange is not None:
        raise ValueError(f"split file '{path}' has '{marks[strange - 1][:20]}' as its entry {strange}; give 1 or 2.")
    if len(marks) != count:
        raise ValueError(
            f"split file '{path}' has {len(marks)} entries, but '{base / 'data'}' holds {count} pairs; "
            "get a complete copy, or load split=all."
        )
    return marks


class FlyingChairs2(FilesDataset):
    """FlyingChairs2: 22232 pairs to train and 640 to validate of 512x384, flow in both directions.

    Occlusions and motion boundaries are read where their files are present.

    Args:
        root: the folder with `train/` and `val/` (or the one above its `FlyingChairs2/`).
        split: train, val, or all.
        direction: forward (img_0 to img_1), backward, or both, one after the other. Backward cases end in `_b`.
        backward: also give the ground truth of the other direction, as `FramePair.backward`.
        cases, skip_bad, max_flow: see FlowDataset. Cases are named 0000000, ...; with split=all train/0000000.

    Raises:
        FileNotFoundError: a folder, frame or flow is missing.
    """

    title = "FlyingChairs2"

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        direction: str = "forward",
        backward: bool = False,
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("train", "val", "all"))
        check_choice("direction", direction, DIRECTIONS)
        folders = ("train", "val") if split == "all" else (split,)
        base = find_root(self.title, root, ("FlyingChairs2",), folders, CHAIRS2_TREE)
        listing = Listing()
        samples: dict[str, Sample] = {}
        for name in folders:
            folder = base / name
            suffix = "-img_0.png"
            stems = sorted(found[: -len(suffix)] for found in listing.names(folder) if found.endswith(suffix))
            if not stems:
                raise missing(self.title, f"folder '{folder}' holds no NUMBER-img_0.png", CHAIRS2_TREE)
            prefix = f"{name}/" if split == "all" else ""
            if direction != "backward":
                samples |= {f"{prefix}{stem}": _sample(listing, folder / stem, "01", backward) for stem in stems}
            if direction != "forward":
                samples |= {f"{prefix}{stem}_b": _sample(listing, folder / stem, "10", backward) for stem in stems}
        super().__init__(root, samples, cases, skip_bad, max_flow)


def _sample(listing: Listing, stem: Path, way: str, backward: bool) -> Sample:
    """`way`: "01" from img_0 to img_1, "10" the other way."""

    def at(ending: str) -> Path:
        return stem.with_name(f"{stem.name}-{ending}")

    def truth(way: str) -> TruthFiles:
        return TruthFiles(
            at(f"flow_{way}.flo"),
            read_dense_flo,
            listing.optional(at(f"occ_{way}.png")),
            listing.optional(at(f"mb_{way}.png")),
        )

    return Sample(at(f"img_{way[0]}.png"), at(f"img_{way[1]}.png"), truth(way), truth(way[::-1]) if backward else None)
