# SPDX-License-Identifier: MIT
"""Flow and uncertainty on scenes of every preset that no training has seen: what a model is good at, and what not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ajna import synth
from ajna.baselines import FlowMethod
from ajna.bootstrap import bootstrap_interval
from ajna.data.synthetic import SyntheticScenes
from ajna.evaluation import MethodReport, Scores, evaluate, mean_scores
from ajna.studies.checks import check_scenes

__all__ = ["COLUMNS", "PresetOptions", "PresetRow", "markdown", "run"]

TOGETHER = "all presets"  # the row over the scenes of all

#: figure of `Scores` -> (heading, digits, factor)
COLUMNS: dict[str, tuple[str, int, float]] = {
    "zero_epe": ("motion px", 2, 1.0),
    "epe": ("EPE px", 2, 1.0),
    "ause": ("AUSE", 3, 1.0),
    "rho": ("Spearman", 2, 1.0),
    "occlusion_auc": ("occlusion AUC", 2, 1.0),
    "motion_boundary_auc": ("boundary AUC", 2, 1.0),
    "expected_boundary_ratio": ("times at boundaries", 1, 1.0),
    "error_boundary_ratio": ("true error's", 1, 1.0),
    "pooled_boundary_ratio": ("times at boundaries, all pixels", 1, 1.0),
    "pooled_error_boundary_ratio": ("true error's, all pixels", 1, 1.0),
    "coverage_90": ("in 90 % interval, %", 1, 100.0),
}


@dataclass
class PresetOptions:
    """scenes: of each preset. seed: of scenes and textures. presets: names; empty: all."""

    scenes: int = 32
    seed: int = 1
    width: int = 320
    height: int = 240
    presets: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_scenes("preset", self.scenes, self.seed, self.width, self.height)
        known = synth.presets()
        for name in self.presets:
            if name not in known:
                raise ValueError(f"unknown scene preset '{name}'; known: {', '.join(known)}")


@dataclass(frozen=True)
class PresetRow:
    """What a method scored on the scenes of a preset, or of all of them (TOGETHER)."""

    preset: str
    method: str
    mean: Scores
    interval: dict[str, tuple[float, float]]  # 95 %, bootstrap over the scenes; of figures with two values or more

    def record(self) -> dict[str, Any]:
        return {"preset": self.preset, "method": self.method, "mean": asdict(self.mean), "interval": self.interval}


def run(
    methods: Mapping[str, FlowMethod], options: PresetOptions, progress: Callable[[float], None] | None = None
) -> list[PresetRow]:
    """Score every method on every preset.

    Args:
        methods: name -> model or baseline. progress: is told the share that is done.
    """
    names = list(options.presets) or list(synth.presets())
    rows = []
    everything = {method: MethodReport() for method in methods}
    done, total = 0, len(names) * options.scenes * len(methods)

    def on_case(*_: Any) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / total)

    for name in names:
        scenes = SyntheticScenes(
            options.scenes, options.width, options.height, seed=options.seed, scene={"preset": name}
        )
        result = evaluate(scenes, methods, size=None, repeats=1, on_case=on_case)
        for method, report in result.methods.items():
            rows.append(_row(name, method, report))
            for figure, pooled in report.pooled.items():
                everything[method].pooled[figure].join(pooled)
            everything[method].cases |= {f"{name}/{case}": scores for case, scores in report.cases.items()}
    if len(names) > 1:
        for method, report in everything.items():
            report.mean = replace(mean_scores(report.cases), **report.pooled_ratios())
            rows.append(_row(TOGETHER, method, report))
    return rows


def _row(preset: str, method: str, report: MethodReport) -> PresetRow:
    intervals = {}
    for figure in (item.name for item in fields(Scores)):
        values = [value for case in report.cases.values() if (value := getattr(case, figure)) is not None]
        if len(values) > 1:
            intervals[figure] = bootstrap_interval(values)
    for figure, pooled in report.pooled.items():
        if (interval := pooled.interval()) is not None:
            intervals[figure] = interval
    return PresetRow(preset, method, report.mean, intervals)


def markdown(rows: Sequence[PresetRow], options: PresetOptions) -> str:
    """A table: presets and methods down, figures with their 95 % intervals across."""
    head = ["preset", "method", *(heading for heading, _, _ in COLUMNS.values())]
    lines = [
        f"{options.scenes} scenes of each preset at {options.width}x{options.height}, seed {options.seed}, means per "
        "image (of 'all pixels': over those of all images) and 95 % bootstrap intervals over the scenes. Seeds and "
        "textures are kept apart from those of training and validation.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    for row in rows:
        cells = [row.preset, row.method]
        for figure, (_, digits, factor) in COLUMNS.items():
            value = getattr(row.mean, figure)
            text = "–" if value is None else f"{factor * value:.{digits}f}"
            if value is not None and figure in row.interval:
                low, high = row.interval[figure]
                text += f" [{factor * low:.{digits}f}, {factor * high:.{digits}f}]"
            cells.append(text)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
