# SPDX-License-Identifier: MIT
"""The endless stream of training batches: a pure function of (run seed, rank, position), so that a resumed run goes on
with exactly the samples that it would have seen."""

from __future__ import annotations

import atexit
import queue
import threading
from bisect import bisect_right
from collections.abc import Callable, Generator, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ajna.data.seeds import derive_seed
from ajna.training.options import Stage, check_stages
from ajna.training.seeds import training_seed

Batch = dict[str, Any]


class Place(NamedTuple):
    """Where a step stands in the curriculum."""

    stage: int
    round: int  # of pool * reuse steps each
    turn: int  # 0 .. reuse - 1: how often the round's batches were used before
    slot: int  # 0 .. pool - 1


def place_of(stages: list[Stage], step: int) -> Place:
    """Stage, round, turn and slot of a training step."""
    index = bisect_right([stage.from_step for stage in stages], step) - 1
    stage, offset = stages[index], step - stages[index].from_step
    if stage.reuse == 1:
        return Place(index, offset, 0, 0)
    round_, rest = divmod(offset, stage.pool * stage.reuse)
    turn, slot = divmod(rest, stage.pool)
    return Place(index, round_, turn, slot)


def augment(batch: Batch, seed: int) -> Batch:
    """Per-sample flips, one transposition (of square crops) and one colour permutation per batch; the input stays.

    All are exact for the flow: flipping left-right negates u, top-bottom v; transposing exchanges u and v.
    """
    random = torch.Generator().manual_seed(seed & (2**62 - 1))
    count = batch["flow"].shape[0]
    flip_x, flip_y = (torch.rand(2, count, generator=random) < 0.5).to(batch["flow"].device)[..., None, None, None]
    colors = torch.randperm(3, generator=random)
    transpose = bool(torch.rand((), generator=random) < 0.5)

    def flipped(x: Tensor) -> Tensor:
        x = torch.where(flip_x, x.flip(3), x)
        return torch.where(flip_y, x.flip(2), x)

    result = {name: flipped(x) if isinstance(x, Tensor) else x for name, x in batch.items()}
    signs = 1.0 - 2.0 * torch.stack([flip_x, flip_y], 1).flatten(1).float()
    result["flow"] = result["flow"] * signs[:, :, None, None]
    for name in ("frame1", "frame2"):
        result[name] = result[name][:, colors]
    if transpose and result["flow"].shape[2] == result["flow"].shape[3]:
        result = {name: x.transpose(2, 3) if isinstance(x, Tensor) else x for name, x in result.items()}
        result["flow"] = result["flow"].flip(1)
    return result


SceneSource = Callable[[int, int, int, int, float], Any]  # (batch, height, width, seed, flow_scale) -> PairBatch


class SceneStream:
    """Iterable over training batches from step ``start`` on, without end.

    A batch is a dict of ``frame1``, ``frame2`` uint8 [B, 3, H, W], ``flow`` float32 [B, 2, H, W] px, ``occlusion`` bool
    [B, 1, H, W] and ``step`` (int).

    Args:
        generator_of: stage -> an ``ajna.synth.PairGenerator``, or alike.
        stages: the curriculum.
        seed: the run's seed.
        rank: of this process among those that train together; each sees its own samples.
        start: first step.
        prefetch: generated batches held ready by a background thread (the generator releases the GIL); 0 generates
            in the calling thread.
    """

    def __init__(
        self,
        generator_of: Callable[[Stage], SceneSource],
        stages: list[Stage],
        seed: int,
        rank: int = 0,
        start: int = 0,
        prefetch: int = 0,
    ) -> None:
        self.generator_of = generator_of
        self.stages = check_stages(stages)
        self.seed, self.rank, self.start, self.prefetch = seed, rank, start, prefetch

    def __iter__(self) -> Generator[Batch, None, None]:
        made: Iterator[Batch] = map(self._generate, self._numbers(self.start))
        if self.prefetch:
            made = in_background(made, self.prefetch)
        step = self.start
        while True:
            pool: list[Batch] = []  # the generated batches of one round
            for step in range(step, self._round_end(step)):  # noqa: B020 - continues where the last round ended
                while len(pool) < self._needed(step):
                    pool.append(next(made))
                yield {**self._batch(pool, place_of(self.stages, step)), "step": step}
            step += 1

    def _numbers(self, step: int) -> Iterator[tuple[int, int]]:
        """(stage, number of the generated batch in it), in the order in which the steps from ``step`` on need them."""
        while True:
            place, end = place_of(self.stages, step), self._round_end(step)
            pool = self._pool(place)
            for slot in range(self._needed(end - 1)):
                yield place.stage, place.round * pool + slot
            step = end

    def _pool(self, place: Place) -> int:
        stage = self.stages[place.stage]
        return stage.pool if stage.reuse > 1 else 1

    def _needed(self, step: int) -> int:
        """How many of its round's generated batches ``step`` needs."""
        place = place_of(self.stages, step)
        return self._pool(place) if place.turn else place.slot + 1

    def _round_end(self, step: int) -> int:
        place = place_of(self.stages, step)
        stage = self.stages[place.stage]
        end = stage.from_step + (place.round + 1) * self._pool(place) * stage.reuse
        following = self.stages[place.stage + 1 :]
        return min(end, following[0].from_step) if following else end

    def _generate(self, number: tuple[int, int]) -> Batch:
        index, count = number
        stage = self.stages[index]
        seed = training_seed(self.seed, index, count, self.rank)
        pairs = self.generator_of(stage)(stage.batch, stage.height, stage.width, seed, stage.motion)
        names = ("frame1", "frame2", "flow", "occlusion")
        return {name: getattr(pairs, name) for name in names}

    def _batch(self, pool: list[Batch], place: Place) -> Batch:
        if place.turn == 0:
            return pool[place.slot]
        stage = self.stages[place.stage]
        seed = derive_seed("reuse", self.seed, self.rank, place.stage, place.round, place.turn)
        random = torch.Generator().manual_seed(seed)
        order = torch.randperm(stage.pool * stage.batch, generator=random)
        chosen = order[place.slot * stage.batch : (place.slot + 1) * stage.batch].tolist()
        batch = {name: torch.stack([pool[i // stage.batch][name][i % stage.batch] for i in chosen]) for name in pool[0]}
        return augment(batch, derive_seed(seed, place.slot))


class _Failure(NamedTuple):
    error: BaseException


def in_background(source: Iterator[Batch], depth: int) -> Iterator[Batch]:
    """Run ``source`` in a thread, at most ``depth`` items ahead; its errors arrive at the consumer."""
    ready: queue.Queue[Batch | _Failure] = queue.Queue(depth)
    stop = threading.Event()

    def put(item: Batch | _Failure) -> bool:
        while not stop.is_set():
            try:
                ready.put(item, timeout=0.2)
                return True
            except queue.Full:
                continue
        return False

    def work() -> None:
        try:
            for item in source:
                if not put(item):
                    return
        except BaseException as error:
            put(_Failure(error))

    thread = threading.Thread(target=work, name="ajna-scenes", daemon=True)

    def finish() -> None:
        # The interpreter must not end while the thread is inside C++.
        stop.set()
        thread.join()

    atexit.register(finish)
    thread.start()
    try:
        while True:
            item = ready.get()
            if isinstance(item, _Failure):
                raise item.error
            yield item
    finally:
        atexit.unregister(finish)
        finish()
