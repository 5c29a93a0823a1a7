# SPDX-License-Identifier: MIT
"""Do boundaries dominate the uncertainty, whatever else disturbs the flow? The paper's Fig. 7, with numbers.

The paper says that uncertainty at depth boundaries is almost always far greater than in regions of low texture, over
100 textures in three scenarios, under blinking light, low texture and a patch that attacks the network. Here every
scene has textures of its own, and every disturbance is applied to all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ajna import analysis
from ajna.analysis import AT_PX, AWAY_PX, BORDER_PX, FLAT_GREY, LEAST_PX
from ajna.bootstrap import bootstrap_interval
from ajna.metrics.functions import roc_auc
from ajna.studies.checks import check_scenes
from ajna.studies.disturbances import DISTURBANCES, Patch, StudyScene, disturbed, make_scene, with_patch

__all__ = ["Condition", "RobustnessOptions", "RobustnessStudy", "SceneFigures", "measure", "run"]

Map = NDArray[np.floating]
Mask = NDArray[np.bool_]

MARGIN_PX = 6  # around what a disturbance touched: neither touched nor untouched


@dataclass
class RobustnessOptions:
    """scenes: each with textures of its own. attacked: further scenes, which the patches are trained on."""

    scenes: int = 120
    seed: int = 0
    width: int = 320
    height: int = 240
    attacked: int = 8

    def __post_init__(self) -> None:
        check_scenes("robustness", self.scenes, self.seed, self.width, self.height, least_px=64)
        if self.attacked < 1:
            raise ValueError(f"robustness study with {self.attacked} scenes to attack: give at least 1")


@dataclass
class SceneFigures:
    """Mean uncertainty (2-norm over the axes) of a scene's regions, and what it ranks; NaN where a region is too small.

    boundary: within 2 px of a motion boundary. flat: local contrast below 4 grey levels, 10 px or more away. textured:
    the rest that far away. touched: what the disturbance covers. auc: probability that a pixel at a boundary is more
    uncertain than one away from it. change_px: mean change of the flow outside of what was touched, against the
    undisturbed pair. boundary_px, flat_px: mean expected error of the calibrated model in these regions; NaN for a
    model without calibration.
    """

    number: int
    boundary: float
    flat: float
    textured: float
    touched: float
    auc: float
    change_px: float
    boundary_px: float = float("nan")
    flat_px: float = float("nan")


@dataclass
class Condition:
    """One disturbance over all scenes."""

    name: str
    scenes: list[SceneFigures] = field(default_factory=list)

    def column(self, name: str) -> NDArray[np.float64]:
        """One figure of all scenes [N]; NaN where it does not apply."""
        return np.array([getattr(scene, name) for scene in self.scenes], dtype=np.float64)

    def ratios(self, region: str, suffix: str = "") -> NDArray[np.float64]:
        """Boundary over region, of the scenes that have both [M]; suffix "_px": of the expected error."""
        ratio = self.column(f"boundary{suffix}") / self.column(f"{region}{suffix}")
        return ratio[np.isfinite(ratio)]

    def record(self) -> dict[str, Any]:
        """Medians and shares over scenes with their 95 % bootstrap intervals, as plain values; None: does not apply."""
        record: dict[str, Any] = {"name": self.name, "scenes": len(self.scenes)}
        for name in ("boundary", "flat", "textured", "touched", "change_px", "boundary_px", "flat_px"):
            _entry(record, name, self.column(name), np.median)
        _entry(record, "auc", self.column("auc"), np.mean)
        # Y goes about with the root of the error it stands for; the claim is also asked of the error in pixels.
        _entry(record, "px_over_flat", self.ratios("flat", "_px"), np.median)
        for region in ("flat", "textured", "touched"):
            ratio = self.ratios(region)
            record[f"scenes_with_{region}"] = int(ratio.size)
            _entry(record, f"over_{region}", ratio, np.median)
            _entry(record, f"above_{region}_share", (ratio > 1).astype(np.float64), np.mean)
        return record


def _entry(record: dict[str, Any], key: str, values: NDArray[np.float64], statistic: Callable[..., Any]) -> None:
    known = values[np.isfinite(values)]
    record[key] = float(statistic(known)) if known.size else None
    record[f"{key}_ci"] = (
        list(bootstrap_interval(known, statistic=lambda s: statistic(s, axis=-1))) if known.size else None
    )


@dataclass
class RobustnessStudy:
    """All conditions, in the order they were run; notes: what was not measured, and why."""

    options: RobustnessOptions
    model: str
    conditions: list[Condition]
    notes: list[str]
    seconds: float = 0.0

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "model": self.model,
            "options": asdict(self.options),
            "conditions": [condition.record() for condition in self.conditions],
            "notes": self.notes,
            "seconds": round(self.seconds, 1),
        }


def _auc(high: Map, low: Map) -> float:
    """The probability that a value of ``high`` is above one of ``low`` (ties count half)."""
    scores = torch.from_numpy(np.concatenate([high, low]))
    positive = torch.arange(scores.numel()) < high.size
    return float(roc_auc(scores, positive))


def measure(scene: StudyScene, field: Any, plain: StudyScene, calm: Any) -> SceneFigures:
    """The figures of one disturbed scene.

    Args:
        field: the flow field of the disturbed pair.
        plain, calm: the scene before it was disturbed, and its flow field.
    """
    uncertainty = np.linalg.norm(field.uncertainty, axis=2)
    inside = np.zeros_like(scene.boundary)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    touched = np.zeros_like(inside) if scene.touched is None else scene.touched
    clear = inside & (analysis.distance_to(touched, MARGIN_PX + 1) > MARGIN_PX if touched.any() else True)
    distance = analysis.distance_to(scene.boundary, AWAY_PX + 1)
    away = clear & (distance > AWAY_PX) & ~scene.occluded
    at = clear & (distance <= AT_PX)
    # Noise must not make a flat wall textured, and low contrast makes a textured one flat.
    contrast = np.minimum(analysis.local_contrast(scene.frame1), analysis.local_contrast(plain.frame1))
    flat = away & (contrast < FLAT_GREY)

    def mean(mask: Mask, values: Map | None = uncertainty) -> float:
        return float(values[mask].mean()) if values is not None and mask.sum() >= LEAST_PX else float("nan")

    expected = getattr(field, "expected_error", None)
    expected_px = None if expected is None else np.linalg.norm(expected, axis=2)
    change = np.linalg.norm(field.flow - calm.flow, axis=2)
    return SceneFigures(
        number=scene.number,
        boundary=mean(at),
        flat=mean(flat),
        textured=mean(away & ~flat),
        touched=mean(touched & inside),
        auc=_auc(uncertainty[at], uncertainty[away]) if min(at.sum(), away.sum()) >= LEAST_PX else float("nan"),
        change_px=float(change[clear].mean()) if clear.any() else float("nan"),
        boundary_px=mean(at, expected_px),
        flat_px=mean(flat, expected_px),
    )


def run(
    model: Any,
    options: RobustnessOptions,
    patches: Sequence[tuple[str, Patch]] = (),
    names: Sequence[str] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Condition]:
    """Measure a model under every disturbance, and under patches.

    Args:
        model: called with two frames, gives a flow field (:class:`ajna.Model`).
        patches: (name of the condition, patch).
        names: of the disturbances; None: all of them.

    Raises:
        ValueError: an unknown disturbance.
    """
    chosen = list(DISTURBANCES) if names is None else list(names)
    for name in chosen:
        if name not in DISTURBANCES:
            raise ValueError(f"unknown disturbance '{name}'; known: {', '.join(DISTURBANCES)}")
    conditions = [Condition(name) for name in [*chosen, *(name for name, _ in patches)]]
    for number in range(options.scenes):
        scene = make_scene(number, options.seed, options.width, options.height)
        calm = model(scene.frame1, scene.frame2)
        pairs = [disturbed(scene, name, options.seed) for name in chosen]
        pairs += [with_patch(scene, patch, options.seed) for _, patch in patches]
        for condition, pair in zip(conditions, pairs, strict=True):
            same = pair.frame1 is scene.frame1 and pair.frame2 is scene.frame2
            condition.scenes.append(measure(pair, calm if same else model(pair.frame1, pair.frame2), scene, calm))
        progress((number + 1) / options.scenes)
    return conditions
