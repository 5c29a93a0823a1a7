# SPDX-License-Identifier: MIT
"""Many trials in worker processes; each leaves a file, so that a killed run goes on where it stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from ajna.model import checkpoint_path
from ajna.sim.episode import EpisodeResult, run_episode
from ajna.sim.methods import METHODS, make_method
from ajna.sim.worlds import make_world

__all__ = ["TrialPlan", "load_trial", "run_trials", "trial_path", "write_json"]

_FORMAT = 1  # of the files; another number is flown again


@dataclass(frozen=True)
class TrialPlan:
    """Trials ``seed`` ... ``seed + trials - 1`` of one method in one world; files in ``out`` / world / method."""

    world: str
    method: str
    trials: int
    seed: int
    out: Path
    weights: Path | None = None
    network_size: tuple[int, int] | None = None
    video: bool = False

    @property
    def folder(self) -> Path:
        return self.out / self.world / self.method


def write_json(path: Path, record: Any) -> None:
    """Write a JSON file that is there completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(record, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def trial_path(plan: TrialPlan, seed: int) -> Path:
    """The file of one trial."""
    return plan.folder / f"trial_{seed:06d}.json"


def _settings(plan: TrialPlan) -> dict[str, Any]:
    """What must be equal for an old file to stand for a new trial."""
    weights = None
    if plan.weights is not None:
        stat = plan.weights.stat()
        weights = [plan.weights.name, stat.st_size, int(stat.st_mtime)]
    elif plan.method in METHODS and METHODS[plan.method].takes_checkpoint:
        weights = [checkpoint_path("best").name]  # the hash is in it: another shipped model flies anew
    return {"format": _FORMAT, "world": plan.world, "method": plan.method, "weights": weights,
            "network_size": list(plan.network_size) if plan.network_size else None}  # fmt: skip


def load_trial(plan: TrialPlan, seed: int) -> EpisodeResult | None:
    """A finished trial from its file; None where there is none, or one of other settings, or a broken one."""
    path = trial_path(plan, seed)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["settings"] != _settings(plan):
            return None
        result = record["result"]
        known = {field.name for field in fields(EpisodeResult)}
        loaded = EpisodeResult(**{key: value for key, value in result.items() if key in known})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    loaded.path = [tuple(point) for point in loaded.path]
    return loaded if loaded.seed == seed else None


def _quiet_threads() -> None:
    """One thread per worker: workers are what runs side by side. Mesa's software renderer reads the first."""
    os.environ.setdefault("LP_NUM_THREADS", "0")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _run_one(plan: TrialPlan, seed: int) -> EpisodeResult:
    """One trial, written to its file (and its video) before it is returned. Runs in a worker."""
    world = make_world(plan.world, seed)
    method = make_method(plan.method, plan.weights, plan.network_size)
    with ExitStack() as stack:
        if hasattr(method, "close"):
            stack.callback(method.close)
        if plan.video:
            from ajna.sim.video import EpisodeVideo

            video = stack.enter_context(EpisodeVideo(world, trial_path(plan, seed).with_suffix(".mp4")))
            result = run_episode(world, method, renderer=video.renderer, watch=video)
        else:
            result = run_episode(world, method)
    write_json(trial_path(plan, seed), {"settings": _settings(plan), "result": asdict(result)})
    return result


def run_trials(
    plan: TrialPlan, workers: int = 1, done: Callable[[EpisodeResult, bool], None] | None = None
) -> list[EpisodeResult]:
    """Fly the plan's trials that have no file yet.

    Args:
        workers: processes; 1: in this one.
        done: called after each trial with its result and whether it came from a file.

    Returns:
        all results in the order of their seeds.

    Raises:
        ValueError: unknown names, impossible numbers, or a method that does not do the world's task.
        RuntimeError: a worker died (no memory, killed).
    """
    if plan.trials < 1:
        raise ValueError(f"{plan.trials} trials: give at least 1")
    if workers < 1:
        raise ValueError(f"{workers} workers: give at least 1")
    results: dict[int, EpisodeResult] = {}
    missing = []
    for seed in range(plan.seed, plan.seed + plan.trials):
        old = load_trial(plan, seed)
        if old is None or (plan.video and not trial_path(plan, seed).with_suffix(".mp4").exists()):
            missing.append(seed)
        else:
            results[seed] = old
            if done is not None:
                done(old, True)
    for result in _flown(plan, missing, min(workers, max(len(missing), 1))):
        results[result.seed] = result
        if done is not None:
            done(result, False)
    return [results[seed] for seed in sorted(results)]


def _flown(plan: TrialPlan, seeds: list[int], workers: int) -> Iterator[EpisodeResult]:
    if workers == 1:
        for seed in seeds:
            yield _run_one(plan, seed)
        return
    # A fresh interpreter per worker: OpenGL contexts and thread pools do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_quiet_threads) as pool:
        pending = {pool.submit(_run_one, plan, seed) for seed in seeds}
        try:
            while pending:
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
