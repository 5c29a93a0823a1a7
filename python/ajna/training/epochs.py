# SPDX-License-Identifier: MIT
"""Training batches from a data set, epoch after epoch: a pure function of (run seed, rank, step), so that a resumed run
goes on with exactly the samples that it would have seen."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from ajna.data.dataset import FlowDataset
from ajna.data.pack_format import common_parts
from ajna.data.packed import PackedDataset, ResidentPack
from ajna.data.seeds import derive_seed
from ajna.training.stream import Batch, in_background
from ajna.training.windows import cropped, fitted_size, pair_tensors, scaled

_FRAMES = ("frame1", "frame2", "valid")


def epoch_order(count: int, run_seed: int, epoch: int) -> list[int]:
    """The order of ``count`` samples in an epoch: the same on all ranks, unrelated between epochs and runs."""
    random = torch.Generator().manual_seed(derive_seed("order", run_seed, epoch))
    return torch.randperm(count, generator=random).tolist()


class PairReader:
    """Reads pairs of a data set as batches of one window size.

    Args:
        dataset: pairs with ground truth.
        window: (height, width) of the batches.
        fit: how frames are scaled before the window is cut, see ``fitted_size``.
        augmenter: cuts the window instead, see ``ajna.synth.Augmenter``.
        workers: threads that decode files; packs need none.

    Raises:
        ValueError: a sample without ground truth.
    """

    def __init__(
        self,
        dataset: FlowDataset,
        window: tuple[int, int],
        fit: str = "cover",
        augmenter: Callable[..., dict[str, Tensor]] | None = None,
        workers: int | None = None,
    ) -> None:
        self.dataset, self.window, self.fit, self.augmenter = dataset, window, fit, augmenter
        kept, _ = common_parts([dataset.parts(index) for index in range(len(dataset))])
        if "flow" not in kept:
            lacking = next(name for i, name in enumerate(dataset.names) if "flow" not in dataset.parts(i))
            raise ValueError(
                f"case '{lacking}' of '{dataset.root}' has no ground truth: nothing to learn from, give another split"
            )
        self._kept = {*_FRAMES, "backward_valid", *kept}
        # A pack of one size is read in one piece; what may be skipped is read one by one.
        packed = isinstance(dataset, PackedDataset) and dataset.size is not None and not dataset.skip_bad
        self._pack = dataset if isinstance(dataset, PackedDataset) and packed else None
        self._resident: ResidentPack | None = None
        self._pool = None if packed else ThreadPoolExecutor(workers or min(8, os.cpu_count() or 1), "ajna-decode")

    def reside(self, device: torch.device | str) -> None:
        """Hold the whole pack in the memory of ``device``.

        Raises:
            ValueError: the data set is no pack of one size, or is read with ``skip_bad``.
        """
        if self._pack is None:
            raise ValueError(
                f"training option data.resident = true: '{self.dataset.root}' is no pack of one size that is read "
                "whole; pack the data set with --size, leave bad samples out there, and give data.dataset packed"
            )
        if self._resident is None:
            self._resident = self._pack.resident(device)

    def batch(
        self, indices: Sequence[int], seeds: Sequence[int] | None = None, device: torch.device | str = "cpu"
    ) -> Batch:
        """The pairs as tensors on ``device``.

        Args:
            indices: which pairs.
            seeds: of each pair's window; None for the central ones, without augmentation.

        Returns:
            ``frame1``, ``frame2`` uint8 [B, 3, h, w], ``flow`` float32 [B, 2, h, w] px, ``valid`` bool [B, 1, h, w],
            ``occlusion`` bool [B, 1, h, w] if all pairs have it, and ``name``: list of B cases.

        Raises:
            ValueError: a damaged sample, sizes that make no batch.
        """
        if self._resident is not None or self._pack is not None:
            if self._resident is not None:
                found = self._resident.batch(indices)
            else:
                assert self._pack is not None
                found = self._pack.batch(indices, device)
            names = [self.dataset.names[index] for index in indices]
            found = self._finish(self._fitted(found), seeds)
        else:
            assert self._pool is not None
            each: Sequence[int | None] = [None] * len(indices) if seeds is None else seeds
            parts = list(self._pool.map(self._read, indices, each))
            names = [name for name, _ in parts]
            found = {k: v.to(device) for k, v in self._joined([tensors for _, tensors in parts]).items()}
            if self.augmenter is not None and seeds is not None:
                found = self._finish(found, seeds)
        return {name: found[name] for name in (*_FRAMES, "flow", "occlusion") if name in found} | {"name": names}

    def _read(self, index: int, seed: int | None) -> tuple[str, dict[str, Tensor]]:
        """One pair, up to the window; with an augmenter, which works on whole batches, up to the scaling."""
        pair = self.dataset[index]
        found = self._fitted(pair_tensors(pair))
        if self.augmenter is None or seed is None:
            found = cropped(found, self.window, None if seed is None else [seed])
        return pair.name, found

    def _joined(self, parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        sizes = {tuple(part["flow"].shape[2:]) for part in parts}
        if len(sizes) > 1:
            shown = " and ".join(f"{width}x{height}" for height, width in sorted(sizes)[:2])
            raise ValueError(
                f"frames of '{self.dataset.root}' differ in size ({shown}), which the augmentation of a batch does not "
                "allow: give data.fit resize"
            )
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0] if name in self._kept}

    def _fitted(self, found: dict[str, Tensor]) -> dict[str, Tensor]:
        size = (int(found["flow"].shape[2]), int(found["flow"].shape[3]))
        kept = {name: value for name, value in found.items() if name in self._kept}
        return scaled(kept, *fitted_size(size, self.window, self.fit))

    def _finish(self, found: dict[str, Tensor], seeds: Sequence[int] | None) -> dict[str, Tensor]:
        if self.augmenter is None or seeds is None:
            return cropped(found, self.window, seeds)
        given = {name: found[name] for name in (*_FRAMES, "flow", "occlusion") if name in found}
        if "backward_flow" in found:  # with it and its masks, frames may be swapped
            back = {name: found.get(f"backward_{name}") for name in ("flow", "valid", "occlusion")}
            given |= {f"{name}_backward": value for name, value in back.items() if value is not None}
        return self.augmenter(given, *self.window, derive_seed("augment", *seeds))


class EpochStream:
    """Iterable over training batches from step ``start`` on, without end.

    An epoch is ``len(dataset) // batch`` steps in its own random order; what is left over has its turn in other epochs.
    A step's batch is shared among the ``world`` processes, each taking every ``world``-th pair of it: no pair is seen
    twice in an epoch, and the pairs of a step do not depend on the number of processes.

    Args:
        reader: of the pairs.
        batch: pairs of a step, over all processes.
        seed: the run's seed.
        rank, world: of this process, and how many train together.
        start: first step.
        device: where packs are taken apart.
        prefetch: batches held ready by a background thread; 0 reads in the calling thread.

    Raises:
        ValueError: a batch that is larger than the data set, or that cannot be shared.
    """

    def __init__(
        self,
        reader: PairReader,
        batch: int,
        seed: int,
        rank: int = 0,
        world: int = 1,
        start: int = 0,
        device: torch.device | str = "cpu",
        prefetch: int = 0,
    ) -> None:
        if batch % world:
            raise ValueError(
                f"training option data.batch = {batch}: it cannot be shared by {world} processes, "
                f"give a multiple of {world}"
            )
        self.reader, self.batch, self.seed, self.rank, self.world = reader, batch, seed, rank, world
        self.start, self.device, self.prefetch = start, device, prefetch
        self.steps_per_epoch = steps_per_epoch(len(reader.dataset), batch)

    def __iter__(self) -> Generator[Batch, None, None]:
        made: Iterator[Batch] = map(self._load, self._places())
        yield from in_background(made, self.prefetch) if self.prefetch else made

    def _places(self) -> Iterator[tuple[int, int, list[int]]]:
        """(step, epoch, the pairs of this rank), step after step."""
        step = self.start
        while True:
            epoch, first = divmod(step, self.steps_per_epoch)
            order = epoch_order(len(self.reader.dataset), self.seed, epoch)
            for number in range(first, self.steps_per_epoch):
                together = order[number * self.batch : (number + 1) * self.batch]
                yield step, epoch, together[self.rank :: self.world]
                step += 1

    def _load(self, place: tuple[int, int, list[int]]) -> Batch:
        step, epoch, indices = place
        seeds = [derive_seed("window", self.seed, epoch, index) for index in indices]
        return {**self.reader.batch(indices, seeds, self.device), "step": step}


def steps_per_epoch(count: int, batch: int) -> int:
    """Whole batches in ``count`` pairs; raises ValueError if there is none."""
    if count < batch:
        raise ValueError(f"training option data.batch = {batch}: the data set has {count} pairs, give at most that")
    return count // batch


class ValidationBatches:
    """The first ``limit`` pairs of a data set in order, as batches; read anew in each validation.

    Each of ``world`` processes takes every ``world``-th pair. All get equally many batches of equal size: what is
    missing is filled with repeated pairs whose pixels are not valid, hence not scored.
    """

    def __init__(
        self,
        reader: PairReader,
        batch: int,
        limit: int | None = None,
        rank: int = 0,
        world: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        count = len(reader.dataset) if limit is None else min(limit, len(reader.dataset))
        self.reader, self.device = reader, device
        # Never larger than what one process has to do.
        self.batch = min(batch, -(-count // world))
        self._mine = list(range(count))[rank::world]
        self._length = -(-count // (world * self.batch))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[Batch]:
        for number in range(self._length):
            wanted = self._mine[number * self.batch : (number + 1) * self.batch]
            filled = wanted + [0] * (self.batch - len(wanted))
            batch: dict[str, Any] = self.reader.batch(filled, None, self.device)
            if len(wanted) < self.batch:
                batch["valid"] = batch["valid"].clone()
                batch["valid"][len(wanted) :] = False
            yield batch
