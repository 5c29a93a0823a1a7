# SPDX-License-Identifier: MIT
"""Many trials in worker processes; each leaves a file, so that a killed run goes on where it stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from ajna.benchmarks.machine import cpu_model
from ajna.model import checkpoint_path
from ajna.sim.episode import EpisodeResult, run_episode
from ajna.sim.methods import METHODS, make_method
from ajna.sim.render import Renderer
from ajna.sim.worlds import make_world

__all__ = ["REFERENCE", "Speed", "TrialPlan", "load_trial", "run_trials", "stored_trials", "trial_path", "write_json"]

_FORMAT = 2  # of the files; another number is flown again
REFERENCE = "depth"  # whose path the others are compared with


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
    record = _read(trial_path(plan, seed))
    if record is None or record["settings"] != _settings(plan):
        return None
    result = _result(record)
    return result if result is not None and result.seed == seed else None


def stored_trials(out: Path, world: str, method: str) -> tuple[list[EpisodeResult], list[dict[str, str]]]:
    """All finished trials of a method in a world that lie in a folder, by seed, and when and where each was flown.

    Trials of an older format, or of another shipped model than the present one, are left out.

    Raises:
        ValueError: trials of different networks of the user's lie side by side.
    """
    found: dict[int, tuple[EpisodeResult, dict[str, str]]] = {}
    networks = set()
    plan = TrialPlan(world, method, 1, 0, out)
    for path in sorted(plan.folder.glob("trial_*.json")):
        record = _read(path)
        if record is None:
            continue
        settings = dict(record["settings"])
        network = settings.get("weights"), settings.get("network_size")
        if METHODS[method].needs_weights:
            settings["weights"] = settings["network_size"] = None  # whichever network it was, if it was the same one
        result = _result(record) if settings == _settings(plan) else None
        if result is not None:
            networks.add(json.dumps(network))
            found[result.seed] = result, record.get("flown", {})
    if len(networks) > 1:
        raise ValueError(f"'{plan.folder}' holds trials of {len(networks)} networks: keep those of one")
    ordered = [found[seed] for seed in sorted(found)]
    return [result for result, _ in ordered], [flown for _, flown in ordered]


def _read(path: Path) -> dict[str, Any] | None:
    """The record of a trial's file, or None where it is missing or not one."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    complete = isinstance(record, dict) and all(isinstance(record.get(key), dict) for key in ("settings", "result"))
    return record if complete else None


def _result(record: dict[str, Any]) -> EpisodeResult | None:
    known = {field.name for field in fields(EpisodeResult)}
    try:
        loaded = EpisodeResult(**{key: value for key, value in record["result"].items() if key in known})
        loaded.path = [tuple(point) for point in loaded.path]
    except TypeError:
        return None
    return loaded


@dataclass
class Speed:
    """How fast trials went: frames flown (pictures, physics, method; reference flights, too) over wall-clock seconds.

    Trials that came from files do not count; all workers count together.
    """

    workers: int = 1
    frames: int = 0
    seconds: float = 0.0

    @property
    def frames_per_s(self) -> float | None:
        """None where nothing was flown."""
        return self.frames / self.seconds if self.frames else None

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "frames_per_s": self.frames_per_s}


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Workers are what runs side by side: one thread each. NumPy's BLAS and Mesa's software renderer read these when
    they are loaded, hence before anything of ours runs in a worker."""
    names = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}
    added = [name for name in names if name not in os.environ]
    os.environ.update({name: names[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV and torch on one thread: their results may depend on the number, run times do."""
    import cv2
    import torch

    before = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])


def _write_trial(plan: TrialPlan, seed: int, result: EpisodeResult) -> None:
    flown = {"date": time.strftime("%Y-%m-%d"), "machine": f"{cpu_model()}, {len(os.sched_getaffinity(0))} cores"}
    write_json(trial_path(plan, seed), {"settings": _settings(plan), "flown": flown, "result": asdict(result)})


def _run_one(plan: TrialPlan, seed: int) -> tuple[EpisodeResult, int]:
    """One trial, written to its file (and its video) before it is returned, and the frames flown. Runs in a worker.

    True depth flies a world once for all methods: its trial is looked up, or flown and kept.
    """
    world = make_world(plan.world, seed)
    method = make_method(plan.method, plan.weights, plan.network_size)
    frames = 0
    with ExitStack() as stack:
        stack.enter_context(_one_thread())
        if hasattr(method, "close"):
            stack.callback(method.close)
        if plan.video:
            from ajna.sim.video import EpisodeVideo

            video = stack.enter_context(EpisodeVideo(world, trial_path(plan, seed).with_suffix(".mp4")))
            renderer = video.renderer
        else:
            video, renderer = None, stack.enter_context(Renderer(world.model, world.camera))
        truth: EpisodeResult | None = None
        if world.task == "navigate" and plan.method != REFERENCE:
            reference = TrialPlan(plan.world, REFERENCE, 1, seed, plan.out)
            truth = load_trial(reference, seed)
            if truth is None:
                truth = run_episode(world, REFERENCE, renderer)
                frames += truth.frames
                _write_trial(reference, seed, truth)
        result = run_episode(world, method, renderer, watch=video, reference=truth)
    _write_trial(plan, seed, result)
    return result, frames + result.frames


def run_trials(
    plan: TrialPlan,
    workers: int = 1,
    done: Callable[[EpisodeResult, bool], None] | None = None,
    speed: Speed | None = None,
) -> list[EpisodeResult]:
    """Fly the plan's trials that have no file yet.

    Args:
        workers: processes; 1: in this one.
        done: called after each trial with its result and whether it came from a file.
        speed: filled in as trials end.

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
    count = min(workers, max(len(missing), 1))
    speed = Speed() if speed is None else speed
    speed.workers = count
    start = time.perf_counter()
    for result, frames in _flown(plan, missing, count):
        results[result.seed] = result
        speed.frames, speed.seconds = speed.frames + frames, time.perf_counter() - start
        if done is not None:
            done(result, False)
    return [results[seed] for seed in sorted(results)]


def _end_with_parent() -> None:
    """End this worker at once when the process that started it is gone.

    A parent that is killed tells its workers nothing: they would fly on, and then wait for ever.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


def _flown(plan: TrialPlan, seeds: list[int], workers: int) -> Iterator[tuple[EpisodeResult, int]]:
    if workers == 1:
        for seed in seeds:
            yield _run_one(plan, seed)
        return
    # A fresh interpreter per worker: OpenGL contexts and thread pools do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool_of_workers = ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent)
    with _environment_of_workers(), pool_of_workers as pool:
        pending = {pool.submit(_run_one, plan, seed) for seed in seeds}
        try:
            while pending:
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                f"a worker process that flew '{plan.world}' by '{plan.method}' was killed or ran out of memory: "
                f"run the same command again, with fewer --workers than {workers}; finished trials are kept"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
