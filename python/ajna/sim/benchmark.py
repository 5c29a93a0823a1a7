# SPDX-License-Identifier: MIT
"""The paper's tables as numbers, and ours beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ajna
from ajna import _core
from ajna.baselines import Cost, OnePass
from ajna.sim.methods import METHODS
from ajna.sim.worlds import WORLDS

__all__ = ["EXPERIMENTS", "PaperRow", "Row", "as_markdown", "cost_of", "rows_of", "task_of"]


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's Table 1 or 2, or of its text: rates in percent, lengths as printed; None: not given."""

    method: str  # our name of it
    title: str
    detection_rate: float | None = None
    success_rate: float | None = None
    path_increase_percent: float | None = None
    safe_point_error_px: float | None = None
    run_time_ms: float | None = None
    gflops: float | None = None
    mparameters: float | None = None


# What flies by the paper's pipelines, beside the paper's own row.
_TRUE_FLOW = PaperRow("ajna-true-flow", "Ajna on true flow")
_OURS = (
    PaperRow("ajna-8hz", "Ajna, planning at 8 Hz"),
    PaperRow("ajna-flight-pace", "Ajna, planning as ajna_flight does"),
    PaperRow("ajna-flight-pace-bfloat16", "Ajna, planning as ajna_flight does in bfloat16"),
    _TRUE_FLOW,
    PaperRow("ajna-true-flow-8hz", "Ajna on true flow, planning at 8 Hz"),
    PaperRow("ajna-true-flow-flight-pace", "Ajna on true flow, planning as ajna_flight does"),
    PaperRow("flight", "Ajna, the flight program over MAVLink"),
)
_TRUE_MOTION = (
    PaperRow("ajna-true-motion", "Ajna on true motion"),
    PaperRow("ajna-true-motion-8hz", "Ajna on true motion, planning at 8 Hz"),
    PaperRow("ajna-true-motion-flight-pace", "Ajna on true motion, planning as ajna_flight does"),
)
_AJNA = {"run_time_ms": 10.1, "gflops": 6.3, "mparameters": 2.7}
_OCCMASK = {"run_time_ms": 31.4, "gflops": 62.7, "mparameters": 20.6}
_MIDAS_S = {"gflops": 43.7, "mparameters": 21.1}
_MIDAS = {"gflops": 1052.9, "mparameters": 344.6}


def _room(success_percent: float) -> tuple[PaperRow, ...]:
    """The rows of a room flown through, with the paper's success rate of Ajna."""
    return (
        PaperRow("depth", "true depth"),
        PaperRow("d435i", "D435i"),
        PaperRow("morpheyes", "MorphEyes"),
        PaperRow("midas-s", "MiDaS-S", **_MIDAS_S),
        PaperRow("midas", "MiDaS", **_MIDAS),
        PaperRow("occmask-net", "OccMask (MaskFlowNet)"),
        PaperRow("occmask", "OccMask (DIS)"),
        PaperRow("ajna", "Ajna", None, success_percent, **_AJNA),
        *_OURS,
        *_TRUE_MOTION,
    )


# Experiment -> rows; the world has the experiment's name.
EXPERIMENTS: dict[str, tuple[PaperRow, ...]] = {
    "dodge": (
        PaperRow("depth", "true depth"),
        PaperRow("d435i", "D435i", 100.0, run_time_ms=1.0),
        PaperRow("midas-s", "MiDaS-S", 0.0, run_time_ms=12.0, **_MIDAS_S),
        PaperRow("midas", "MiDaS", 3.1, run_time_ms=137.8, **_MIDAS),
        PaperRow("evdodgenet", "EVDodgeNet (SegNet)", 40.4, run_time_ms=2.5, gflops=0.2, mparameters=0.03),
        PaperRow(
            "evdodgenet-flow", "EVDodgeNet (DB + H + SegFlowNet)", 90.7, run_time_ms=11.0, gflops=5.2, mparameters=3.6
        ),
        PaperRow("events", "event density"),
        PaperRow("occmask-net", "OccMask (MaskFlowNet)", 74.8, **_OCCMASK),
        PaperRow("occmask", "OccMask (DIS)"),
        PaperRow("morpheyes", "MorphEyes"),
        PaperRow("ajna", "Ajna", 89.2, 83.3, **_AJNA),
        *_OURS,
    ),
    "gap": (
        PaperRow("depth", "true depth"),
        PaperRow("gapflyt-pwcnet", "GapFlyt (PWC-Net)", 94.2, run_time_ms=91.0, gflops=90.8, mparameters=8.75),
        PaperRow("gapflyt-flownet2", "GapFlyt (FlowNet2)", 93.0, run_time_ms=124.0, gflops=24836.4, mparameters=162.5),
        PaperRow("gapflyt-spynet", "GapFlyt (SpyNet)", 74.0, run_time_ms=70.0, gflops=149.8, mparameters=1.2),
        PaperRow("gapflyt", "GapFlyt (DIS)"),
        PaperRow("d435i", "D435i", 100.0, run_time_ms=1.0),
        PaperRow("midas-s", "MiDaS-S", 0.0, run_time_ms=12.0, **_MIDAS_S),
        PaperRow("midas", "MiDaS", 30.1, run_time_ms=137.8, **_MIDAS),
        PaperRow("occmask-net", "OccMask (MaskFlowNet)", 56.2, **_OCCMASK),
        PaperRow("occmask", "OccMask (DIS)"),
        PaperRow("morpheyes", "MorphEyes"),
        PaperRow("ajna", "Ajna", 91.0, **_AJNA),
        *_OURS,
    ),
    "forest": (
        PaperRow("depth", "true depth"),
        PaperRow("morpheyes", "MorphEyes", None, 99.0, 0.6, 1.1, 2.5),
        PaperRow("midas-s", "MiDaS-S", None, 32.0, 7.8, 6.8, 13.4, **_MIDAS_S),
        PaperRow("midas", "MiDaS", None, 97.0, 1.0, 1.1, 139.2, **_MIDAS),
        PaperRow("occmask-net", "OccMask (MaskFlowNet)", None, 0.0, None, 40.0, 35.3, 62.7, 20.6),
        PaperRow("occmask", "OccMask (DIS)"),
        PaperRow("d435i", "D435i"),
        PaperRow("ajna", "Ajna", None, 92.0, 2.7, 4.1, 11.6, 6.3, 2.7),
        *_OURS,
        *_TRUE_MOTION,
    ),
    "indoor-forest": _room(86.0),
    "boxes": _room(82.0),
    "pile": (
        PaperRow("depth", "true depth"),
        PaperRow("d435i", "D435i"),
        PaperRow("morpheyes", "MorphEyes"),
        PaperRow("midas-s", "MiDaS-S", **_MIDAS_S),
        PaperRow("midas", "MiDaS", **_MIDAS),
        PaperRow("mask-rcnn", "Mask R-CNN"),
        PaperRow("pointrend", "PointRend"),
        PaperRow("occmask-net", "OccMask (MaskFlowNet)"),
        PaperRow("occmask", "OccMask (DIS)"),
        PaperRow("ajna", "Ajna", **_AJNA),
        _TRUE_FLOW,
    ),
}


def task_of(world: str) -> str:
    """What is flown in a world, without making it.

    Raises:
        ValueError: for an unknown world (the nearest is named).
    """
    if world not in WORLDS:
        near = _core.nearest_name(world, list(WORLDS))
        hint = f"did you mean '{near}'? " if near else ""
        raise ValueError(f"unknown world '{world}'; {hint}Known: {', '.join(WORLDS)}")
    return world if world in ("gap", "dodge", "pile") else "navigate"


@dataclass
class Row:
    """The paper's row and our summary (see :func:`ajna.sim.statistics.summarize`), where there is one.

    ``cost``: of an answer of our network; None for methods without it. ``other_model``: the shipped model of an earlier
    version that flew; empty where it was the present one, or none flies.
    """

    paper: PaperRow
    measured: dict[str, Any] | None = None
    cost: Cost | None = None
    other_model: str = ""

    @property
    def method(self) -> str:
        return self.paper.method

    @property
    def needs_weights(self) -> bool:
        return METHODS[self.method].needs_weights

    @property
    def note(self) -> str:
        """Why there are no numbers of ours; empty where there are."""
        if self.measured is not None:
            return ""
        return "weights not given" if self.needs_weights else "not run"

    def to_json(self) -> dict[str, Any]:
        paper = {key: value for key, value in vars(self.paper).items() if key not in ("method", "title")}
        return {"method": self.method, "title": self.paper.title, "paper": paper, "measured": self.measured,
                "cost": None if self.cost is None else self.cost._asdict(), "note": self.note}  # fmt: skip


def rows_of(experiment: str, methods: Sequence[str] | None = None) -> list[Row]:
    """The rows of an experiment that can be run (all rows where ``methods`` is None).

    Raises:
        ValueError: an unknown experiment, or a method that is not in it.
    """
    task_of(experiment)
    rows = [Row(row) for row in EXPERIMENTS[experiment]]
    known = [row.method for row in rows]
    for name in methods or []:
        if name not in known:
            near = _core.nearest_name(name, known)
            hint = f"did you mean '{near}'? " if near else ""
            raise ValueError(f"'{name}' is not a method of '{experiment}'; {hint}Known: {', '.join(known)}")
    if methods is None:
        return rows
    return [row for row in rows if row.method in methods]


def cost_of(method: str, weights: str | Path | None = None) -> Cost | None:
    """What an answer of our network takes in a method, at the camera's 320x240; None for methods without it.

    ``weights``: a model file; None: the shipped model.
    """
    if not METHODS[method].takes_checkpoint:
        return None
    return OnePass(ajna.load("best" if weights is None else str(weights))).cost(320, 240)


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _measured(record: dict[str, Any] | None, key: str, scale: float = 1.0) -> str:
    """A figure with its interval; a dash where it does not apply."""
    if record is None or record.get(key) is None:
        return "–"
    low, high = record[f"{key}_ci"]
    return f"{scale * record[key]:.1f} [{scale * low:.1f}, {scale * high:.1f}]"


def as_markdown(experiment: str, rows: Sequence[Row]) -> str:
    """A Markdown table: each figure as the paper prints it, then ours with its 95 % interval.

    Of columns that the paper leaves empty for the whole table only ours are shown. The number of trials is followed by
    the model that flew them where that is not the present one.
    """
    columns = [("success %", "success_rate", 100.0)]
    if task_of(experiment) == "navigate":
        columns.append(("speed m/s", "cruise_speed_m_s", 1.0))
        columns += [
            ("path increase %", "path_increase_percent", 1.0),
            ("safe point error px", "safe_point_error_px", 1.0),
            ("same, to its own planner's on true motion, px", "safe_point_error_same_px", 1.0),
        ]
    else:
        columns.append(("detection %", "detection_rate", 100.0))
        if task_of(experiment) != "pile":  # looked at once
            columns.append(("detection on any later frame %", "detection_rate_best", 100.0))
    columns.append(("run time ms", "run_time_ms", 1.0))
    printed = {key for _, key, _ in columns for row in EXPERIMENTS[experiment] if getattr(row, key, None) is not None}
    head = ["method", "trials"]
    for title, key, _ in columns:
        head += [f"{title}, paper", f"{title}, ours"] if key in printed else [f"{title}, ours"]
    head += ["GFLOP, paper", "GFLOP, ours", "M parameters, paper", "M parameters, ours"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        trials = row.note if row.measured is None else str(row.measured["trials"])
        cells = [row.paper.title, f"{trials} ({row.other_model})" if row.other_model else trials]
        for _, key, scale in columns:
            cells += [_number(getattr(row.paper, key))] if key in printed else []
            cells.append(_measured(row.measured, key, scale))
        flops, parameters = (None, None) if row.cost is None else (row.cost.flops, row.cost.parameters)
        cells += [_number(row.paper.gflops), _number(None if flops is None else flops / 1e9)]
        cells += [_number(row.paper.mparameters, 2), _number(None if parameters is None else parameters / 1e6, 2)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
