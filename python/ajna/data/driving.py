# SPDX-License-Identifier: MIT
"""Sets recorded from cars, with sparse ground truth: KITTI 2012, KITTI 2015, HD1K."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from ajna import io
from ajna.data.files import FilesDataset, Listing, Sample, TruthFiles, check_choice, find_root, missing

HD1K_TREE = """\
  ROOT/hd1k_input/image_2/000000_0010.png
  ROOT/hd1k_input/image_2/000000_0011.png
  ROOT/hd1k_flow_gt/flow_occ/000000_0010.png
  ROOT/hd1k_challenge/image_2/...   (for split=test)"""


class _Kitti(FilesDataset):
    images: ClassVar[str]
    archive: ClassVar[str]

    def __init__(
        self,
        root: str | Path,
        split: str = "training",
        ground_truth: str = "occ",
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("training", "testing"))
        check_choice("ground_truth", ground_truth, ("occ", "noc"))
        tree = (
            f"  ROOT/training/{self.images}/000000_10.png\n  ROOT/training/{self.images}/000000_11.png\n"
            "  ROOT/training/flow_occ/000000_10.png\n  ROOT/training/flow_noc/000000_10.png\n"
            f"  ROOT/testing/{self.images}/...   (for split=testing)"
        )
        needed = [f"{split}/{self.images}", *([f"training/flow_{ground_truth}"] if split == "training" else [])]
        base = find_root(self.title, root, (self.archive,), needed, tree) / split
        listing = Listing()
        frames = base / self.images
        numbers = sorted(n[:6] for n in listing.names(frames) if re.fullmatch(r"\d{6}_10\.png", n))
        if not numbers:
            raise missing(self.title, f"folder '{frames}' holds no 000000_10.png", tree)
        samples = {}
        for number in numbers:
            truth = None
            if split == "training":
                flow = base / f"flow_{ground_truth}" / f"{number}_10.png"
                # What is known, but not among the pixels that stay visible, leaves the frame or gets hidden.
                visible = listing.optional(base / "flow_noc" / flow.name) if ground_truth == "occ" else None
                truth = TruthFiles(flow, io.read_kitti_flow, visible_flow=visible)
            samples[number] = Sample(frames / f"{number}_10.png", frames / f"{number}_11.png", truth)
        super().__init__(root, samples, cases, skip_bad, max_flow)


_KITTI_DOC = """{title}: {count} training pairs, about 1242x375, sparse ground truth from a laser scanner.

    The occlusion mask is made of the two ground truths: known in `flow_occ`, but not in `flow_noc`; it means nothing
    where the ground truth is not valid.

    Args:
        root: the folder with `training/` (or the one above its `{archive}/`).
        split: training, or testing (frames only).
        ground_truth: occ (all known pixels) or noc (only those that stay visible; no occlusion mask).
        cases, skip_bad, max_flow: see FlowDataset. Cases are named 000000, ...

    Raises:
        FileNotFoundError: a folder or file is missing.
    """


class Kitti2012(_Kitti):
    title = "KITTI 2012"
    images = "colored_0"
    archive = "data_stereo_flow"
    __doc__ = _KITTI_DOC.format(title=title, count=194, archive=archive)


class Kitti2015(_Kitti):
    title = "KITTI 2015"
    images = "image_2"
    archive = "data_scene_flow"
    __doc__ = _KITTI_DOC.format(title=title, count=200, archive=archive)


class HD1K(FilesDataset):
    """HD1K: about a thousand frames of 36 sequences, 2560x1080, sparse ground truth.

    Args:
        root: the folder with `hd1k_input/` and `hd1k_flow_gt/`.
        split: train, or test (`hd1k_challenge/`, frames only).
        cases, skip_bad, max_flow: see FlowDataset. Cases are named SEQUENCE_FRAME, 000000_0010, ...

    Raises:
        FileNotFoundError: a folder or file is missing.
    """

    title = "HD1K"

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        check_choice("split", split, ("train", "test"))
        source = "hd1k_input" if split == "train" else "hd1k_challenge"
        needed = [f"{source}/image_2", *(["hd1k_flow_gt/flow_occ"] if split == "train" else [])]
        base = find_root(self.title, root, ("hd1k_full_package", "hd1k", "HD1K"), needed, HD1K_TREE)
        listing = Listing()
        frames, flows = base / source / "image_2", base / "hd1k_flow_gt/flow_occ"
        pattern = re.compile(r"(\d{6})_(\d{4})\.png")
        found = sorted(match.groups() for n in listing.names(frames) if (match := pattern.fullmatch(n)))
        known = set(found)
        samples = {}
        for sequence, frame in found:
            following = f"{int(frame) + 1:04d}"
            if (sequence, following) not in known:
                continue  # the last frame of a sequence
            name = f"{sequence}_{frame}"
            truth = TruthFiles(flows / f"{name}.png", io.read_kitti_flow) if split == "train" else None
            samples[name] = Sample(frames / f"{name}.png", frames / f"{sequence}_{following}.png", truth)
        if not samples:
            raise missing(self.title, f"folder '{frames}' holds no two successive frames", HD1K_TREE)
        super().__init__(root, samples, cases, skip_bad, max_flow)
