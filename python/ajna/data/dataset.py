# SPDX-License-Identifier: MIT
"""What all data sets have in common: order, names, bad samples. Needs no image files, hence no vision build."""

from __future__ import annotations

import difflib
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from torch.utils.data import Dataset

from ajna.data.frame_pair import FramePair, Truth

# What a damaged, missing or nonsensical file raises. A refusing machine (RuntimeError) is not the sample's fault.
BAD_SAMPLE_ERRORS = (ValueError, FileNotFoundError)


class FlowDataset(Dataset[FramePair]):
    """Frame pairs in a fixed order; a pair is read when it is asked for.

    Attributes:
        root: the folder of the data set.
        names: the cases, in order; unique.
        bad: case -> why it cannot be used, for the cases met so far; filled only with ``skip_bad``. Worker processes
            of a DataLoader have their own copy: pack the data set to have one list of all bad samples.

    Args:
        root: the folder.
        names: the cases.
        skip_bad: record an unusable sample in ``bad`` and give the next usable one in its place, where the default
            is to raise.
        max_flow: pixels whose true motion is longer along an axis count as not valid; by default all count.
    """

    title: ClassVar[str] = "data set"

    def __init__(
        self, root: str | Path, names: Iterable[str], skip_bad: bool = False, max_flow: float | None = None
    ) -> None:
        if max_flow is not None and not max_flow > 0:
            raise ValueError(f"max_flow={max_flow} leaves no pixel; give a length in pixels above 0.")
        self.root = Path(root)
        self.skip_bad, self.max_flow = skip_bad, max_flow
        self.names: tuple[str, ...] = tuple(names)
        self.bad: dict[str, str] = {}

    @abstractmethod
    def read(self, index: int) -> FramePair:
        """Read one sample, whatever `skip_bad` says.

        Raises:
            ValueError: damaged files, flow that is not finite, parts whose sizes differ; names the file.
            FileNotFoundError: a file is missing.
        """

    @abstractmethod
    def files(self, index: int) -> list[Path]:
        """The files that a sample is read from."""

    @abstractmethod
    def parts(self, index: int) -> frozenset[str]:
        """What a sample has beyond its frames, without reading it: flow, occlusion, motion_boundary, backward_..."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> FramePair:
        index = range(len(self))[index]
        if not self.skip_bad:
            return self.read(index)
        for step in range(len(self)):
            pair = self._readable((index + step) % len(self))
            if pair is not None:
                return pair
        raise self.none_left()

    def none_left(self) -> ValueError:
        """The error where every sample is bad."""
        return ValueError(
            f"none of the {len(self)} samples of '{self.root}' can be used; the first: {next(iter(self.bad.values()))}"
        )

    def _readable(self, index: int) -> FramePair | None:
        name = self.names[index]
        if name in self.bad:
            return None
        try:
            return self.read(index)
        except BAD_SAMPLE_ERRORS as error:
            self.bad[name] = str(error)
            return None

    def pairs(self) -> Iterator[FramePair]:
        """Every sample once, in order; with `skip_bad` without the bad ones, which are then all in `bad`."""
        for index in range(len(self)):
            pair = self._readable(index) if self.skip_bad else self.read(index)
            if pair is not None:
                yield pair


def limited(truth: Truth, max_flow: float | None) -> Truth:
    """The ground truth with 0 where it is not valid, and not valid where an axis moves farther than `max_flow`."""
    valid = truth.valid
    if max_flow is not None:
        with np.errstate(invalid="ignore"):  # what is not valid may be NaN
            valid = valid & (np.abs(truth.flow) <= max_flow).all(axis=-1)
    return replace(truth, flow=np.where(valid[..., None], truth.flow, np.float32(0)), valid=valid)


def check_names(names: Iterable[str], known: Iterable[str], root: str | Path) -> None:
    """Raise ValueError, with the nearest or the known names, if one of `names` is not a case."""
    known = list(known)
    lookup = frozenset(known)
    for name in names:
        if name not in lookup:
            near = difflib.get_close_matches(name, known, n=1)
            more = f" and {len(known) - 12} more" if len(known) > 12 else ""
            hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known[:12])}{more}."
            raise ValueError(f"'{name}' is not a case of '{root}'; {hint}")
