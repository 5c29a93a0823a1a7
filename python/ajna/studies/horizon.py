# SPDX-License-Identifier: MIT
"""What a network's uncertainty along the horizon says of distance: the law that navigating reads a map by, fitted anew.

True depth flies forests; on its frames the network's map is taken as the skill takes it, and beside each column's mean
uncertainty stands the true distance there. The law is that of :class:`ajna.tasks.HorizonOptions`,
``Y = floor + per_px (r + least_shift_px) b / Z``, which is linear in three coefficients. It is fitted to pairs a tenth
of a second apart: further apart near things move so far that uncertainty grows no more, and what is free would set the
law. How well distances are read is measured on the pairs that the skill takes.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import tasks
from ajna.sim.episode import run_episode
from ajna.sim.methods import make_method
from ajna.sim.methods.signals import Signal
from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.worlds import World, make_world

__all__ = ["Columns", "HorizonStudy", "Law", "columns_of", "fit", "markdown", "run"]

Floats = NDArray[np.float64]
Map = NDArray[np.float32]

EVERY = 5  # frames: neighbours show the same
FIT_BASELINE_S = 0.1
NEAR_M, FAR_M = 4.0, 8.0
DISTANCES_M = (0.0, 2.0, 3.0, 4.0, 6.0, 9.0, np.inf)


@dataclass(frozen=True)
class Columns:
    """One entry per image column and frame.

    Attributes:
        uncertainty: mean over the band about the horizon, units of the map.
        shift_px: mean distance of the band's pixels from the focus of expansion.
        closing: the camera's motion between the frames over the depth there, b / Z.
        distance_m: true distance on the ground plan; infinite where nothing stands.
        per_depth: distance over depth of that pixel's ray.
        move_m: how far the camera moved between the frames.
    """

    uncertainty: Floats
    shift_px: Floats
    closing: Floats
    distance_m: Floats
    per_depth: Floats
    move_m: Floats

    def __len__(self) -> int:
        return len(self.uncertainty)

    @staticmethod
    def joined(parts: Sequence[Columns]) -> Columns:
        """All entries of several, in order."""
        names = Columns.__dataclass_fields__
        return Columns(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True)
class Law:
    """Coefficients of the law, as in :class:`ajna.tasks.HorizonOptions`."""

    floor: float
    per_px: float
    least_shift_px: float

    @classmethod
    def of(cls, options: tasks.HorizonOptions) -> Law:
        """That of a skill's options."""
        return cls(options.floor, options.per_px, options.least_shift_px)

    def distances(self, columns: Columns) -> Floats:
        """What the skill takes the columns' distances for, metres; infinite where it sees nothing."""
        excess = columns.uncertainty - self.floor
        with np.errstate(divide="ignore"):
            depth = self.per_px * (columns.shift_px + self.least_shift_px) * columns.move_m / np.maximum(excess, 0.0)
        return np.asarray(depth * columns.per_depth)


@dataclass(frozen=True)
class HorizonStudy:
    """The columns of the skill's own pairs, the law that they were read by, and the one fitted to shorter pairs."""

    forests: int
    seed: int
    frames: int
    columns: Columns
    present: Law
    fitted: Law

    def record(self) -> dict[str, Any]:
        """Everything that is printed, as JSON takes it."""
        return {
            "forests": self.forests,
            "seed": self.seed,
            "frames": self.frames,
            "columns": len(self.columns),
            "present": {**vars(self.present), **quality(self.columns, self.present)},
            "fitted": {**vars(self.fitted), **quality(self.columns, self.fitted)},
        }


def columns_of(
    map_: Map, depth: NDArray[np.float32], heading_from_camera: Floats, move_m: Floats, options: tasks.HorizonOptions,
    fov_rad: float,
) -> Columns | None:  # fmt: skip
    """Uncertainty and true distance of each column of a map; None where the skill would not look at it.

    Both are read by :func:`ajna.tasks.horizon_obstacles`, with a law that lets every column through, so that the band
    is the skill's own.

    Args:
        map_: scalar uncertainty, float32 [H, W]; depth: true, metres, infinite where there is nothing.
        move_m: of the camera between the frames, heading frame [3]; fov_rad: horizontal field of view.
    """
    open_law = tasks.HorizonOptions()
    open_law.band, open_law.column_step, open_law.min_move_m = options.band, options.column_step, options.min_move_m
    open_law.floor, open_law.per_px, open_law.least_shift_px, open_law.max_distance_m = 0.0, 1e-3, 1.0, 1000.0
    open_law.saturated = open_law.range_moves = 1e6  # all in one list, in the columns' order
    inverse = np.where(np.isfinite(depth), 1.0 / np.maximum(depth, 1e-3), 0.0)
    move = float(np.linalg.norm(move_m))
    # Above zero everywhere, or a column would be let out and the lists would not match. The first, equal in all
    # columns, gives their distance from the focus of expansion.
    depths = []
    for read in (np.ones_like(inverse), map_ + 1.0, inverse + 1.0):
        points = tasks.horizon_obstacles(read.astype(np.float32), heading_from_camera, fov_rad, move_m, open_law)
        if len(points) == 0:
            return None
        # Points lie on the horizon, without a vertical part in the heading frame.
        depths.append(points @ heading_from_camera[:2, 2])
    per_depth = np.linalg.norm(points, axis=1) / depths[-1]
    uncertainty, mean_inverse = depths[0] / depths[1] - 1.0, depths[0] / depths[2] - 1.0
    mean_inverse = np.where(mean_inverse > 1e-4, mean_inverse, 0.0)
    with np.errstate(divide="ignore"):
        distance = np.where(mean_inverse > 0, per_depth / mean_inverse, np.inf)
    shift = depths[0] / (open_law.per_px * move) - open_law.least_shift_px
    return Columns(uncertainty, shift, move * mean_inverse, distance, per_depth, np.full(len(shift), move))


class _Recorder:
    """True depth flies; beside it the columns of every few frames are kept."""

    name = "depth"
    needs = frozenset({"rgb", "depth"})

    def __init__(self, signal: Signal, options: tasks.SkillOptions) -> None:
        self._signal, self._options = signal, options
        self._pilot = make_method("depth")
        self.kept: list[Columns] = []
        self.short: list[Columns] = []

    def reset(self, setup: TaskSetup) -> None:
        self._pilot.reset(setup)
        self._source, self._fov_rad = self._signal.source(setup.camera), setup.camera.horizontal_fov_rad
        self._apart, self._short = (
            max(1, round(seconds * setup.camera.rate_hz)) for seconds in (self._options.baseline_s, FIT_BASELINE_S)
        )
        self._frames: deque[tuple[Observation, tasks.Snapshot]] = deque(maxlen=1 + max(self._apart, self._short))
        self._count = 0

    def __call__(self, observation: Observation) -> Output:
        self._count += 1
        now = tasks.Snapshot(
            observation.frame.time_s,
            observation.rgb,
            observation.heading_from_camera,
            -observation.yaw_rad,
            observation,
        )
        self._frames.append((observation, now))
        if self._count % EVERY == 0 and len(self._frames) == self._frames.maxlen:
            self._keep(observation, now, self._apart, self.kept)
            self._keep(observation, now, self._short, self.short)
        return self._pilot(observation)

    def _keep(self, seen: Observation, now: tasks.Snapshot, apart: int, to: list[Columns]) -> None:
        earlier, before = self._frames[-1 - apart]
        interval_s = seen.frame.time_s - earlier.frame.time_s
        if _turn(seen, earlier) > self._options.max_turn_rad_s * interval_s:
            return  # blurred: the skill does not look, either
        found = columns_of(
            np.asarray(self._source(now, before, "rotation")),
            seen.frame.depth,
            seen.heading_from_camera,
            _moved(seen, earlier),
            self._options.horizon,
            self._fov_rad,
        )
        if found is not None:
            to.append(found)


def _moved(seen: Observation, earlier: Observation) -> Floats:
    """The camera's way between two frames, heading frame of the later one."""
    pose = seen.frame.T_world_camera
    way = pose[:3, 3] - earlier.frame.T_world_camera[:3, 3]
    return np.asarray(seen.heading_from_camera @ (pose[:3, :3].T @ way))


def _turn(a: Observation, b: Observation) -> float:
    """Angle between two attitudes, radians."""
    turn = a.frame.T_world_camera[:3, :3].T @ b.frame.T_world_camera[:3, :3]
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def fit(columns: Columns, rounds: int = 30) -> Law:
    """The law by robust least squares (Huber's weights, scale from the median deviation), least_shift_px from 0 on.

    Raises:
        ValueError: uncertainty that does not grow with what comes near, or too few columns to tell.
    """
    if len(columns) < 100:
        raise ValueError(f"{len(columns)} columns are too few to fit distances to: fly more forests")
    design = np.stack([np.ones(len(columns)), columns.shift_px * columns.closing, columns.closing], axis=1)
    floor, per_px, constant = _robust(design, columns.uncertainty, rounds)
    if constant < 0:  # none below 0: then the best with 0
        (floor, per_px), constant = _robust(design[:, :2], columns.uncertainty, rounds), 0.0
    if not (per_px > 0 and floor >= 0):
        raise ValueError(
            f"uncertainty does not grow with what comes near (floor {floor:.3g}, {per_px:.3g} per pixel): a map of "
            "this network cannot be read as distances"
        )
    return Law(float(floor), float(per_px), float(constant / per_px))


def _robust(design: Floats, values: Floats, rounds: int) -> Floats:
    weight = np.ones(len(values))
    for _ in range(rounds):
        root = np.sqrt(weight)
        solution, *_ = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)
        miss = np.abs(values - design @ solution)
        scale = 1.345 * 1.4826 * max(float(np.median(miss)), 1e-9)
        weight = np.minimum(1.0, scale / np.maximum(miss, 1e-12))
    return np.asarray(solution)


def quality(columns: Columns, law: Law) -> dict[str, Any]:
    """How well distances are read: what is missed, what is seen where nothing is, and the ratio of read to true.

    missed: share of the columns nearer than 4 m that look farther than 8 m; false: of those farther than 8 m that look
    nearer than 4 m; ratio: 10th, 50th and 90th percentile of read over true distance, of columns nearer than 8 m.
    """
    read, true = law.distances(columns), columns.distance_m
    near, far = true < NEAR_M, true > FAR_M
    both = (true < FAR_M) & np.isfinite(read)
    ratio = np.quantile(read[both] / true[both], [0.1, 0.5, 0.9]) if both.any() else np.full(3, np.nan)
    return {
        "missed": float((read[near] > FAR_M).mean()) if near.any() else None,
        "false": float((read[far] < NEAR_M).mean()) if far.any() else None,
        "ratio": [float(value) for value in ratio],
    }


def run(
    signal: Signal,
    forests: int = 4,
    seed: int = 1002,
    make: Callable[[int], World] | None = None,
    progress: Callable[[float], None] | None = None,
) -> HorizonStudy:
    """Fly forests by true depth, and fit the law to what the signal's map shows on the way.

    Args:
        signal: where the maps come from; seed: of the first forest (from 1000 on they are apart from the trials').
        make: the world of a seed; by default the forest.

    Raises:
        ValueError: no forests, or see :func:`fit`; NoRenderingError: nothing can be rendered here.
    """
    if forests < 1:
        raise ValueError(f"{forests} forests: give at least one")
    options = tasks.SkillOptions()
    signal.adapt(options)
    kept: list[Columns] = []
    short: list[Columns] = []
    for index in range(forests):
        world = make(seed + index) if make is not None else make_world("forest", seed + index)
        recorder = _Recorder(signal, options)
        run_episode(world, recorder, reference=False)
        kept += recorder.kept
        short += recorder.short
        if progress is not None:
            progress((index + 1) / forests)
    if not kept or not short:
        raise ValueError("no frame shows the horizon while the vehicle moves: fly more forests")
    columns = Columns.joined(kept)
    return HorizonStudy(forests, seed, len(kept), columns, Law.of(options.horizon), fit(Columns.joined(short)))


def markdown(study: HorizonStudy) -> str:
    """The two laws, and what each makes of true distances."""
    lines = ["| law | floor | per_px | least_shift_px | missed, % | false, % | read over true, 10 / 50 / 90 % |"]
    lines.append("|---|" + "---|" * 6)
    for name, law in (("present", study.present), ("fitted", study.fitted)):
        figures = quality(study.columns, law)
        missed, false = (
            "–" if figures[key] is None else f"{100 * figures[key]:.1f}" for key in ("missed", "false")
        )  # fmt: skip
        ratio = " / ".join(f"{value:.2f}" for value in figures["ratio"])
        lines.append(
            f"| {name} | {law.floor:.3f} | {law.per_px:.4f} | {law.least_shift_px:.1f} | {missed} | {false} | {ratio} |"
        )
    lines += [
        "",
        "| true distance m | columns | Y | read by the present law, m | by the fitted one, m |",
        "|---|---|---|---|---|",
    ]
    for low, high in itertools.pairwise(DISTANCES_M):
        chosen = (study.columns.distance_m >= low) & (study.columns.distance_m < high)
        if np.isinf(high):
            chosen = study.columns.distance_m >= low
        if not chosen.any():
            continue
        cells = [
            " / ".join(
                "free" if value > 99 else f"{value:.1f}" for value in _quantiles(law.distances(study.columns)[chosen])
            )
            for law in (study.present, study.fitted)
        ]
        mean = study.columns.uncertainty[chosen].mean()
        name = f"from {low:g}" if np.isinf(high) else f"{low:g} to {high:g}"
        lines.append(f"| {name} | {chosen.sum()} | {mean:.2f} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)


def _quantiles(values: Floats) -> Floats:
    """10th, 50th and 90th percentile, infinite values included (those between two ranks are not averaged)."""
    return np.asarray(np.quantile(values, [0.1, 0.5, 0.9], method="nearest"))
