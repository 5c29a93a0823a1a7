# SPDX-License-Identifier: MIT
"""Score flow methods and their uncertainty on frame pairs: the figures behind `ajna evaluate`.

Conventions: every figure is per image (`ajna.metrics` says which), a mean row is the mean over the cases that have the
figure. Frames are resized by area and ground truth by nearest pixel, with vectors scaled to the new size. Scored are
the pixels with known, valid ground truth; the AUCs count among these, too. Motion boundaries are those of the data set,
or else the jumps of its ground truth (`ajna.metrics.motion_boundaries`). Calibration is scored only for models that are
calibrated; beside the figures of each case its form over all cases together is in `calibration`. `run_time_ms` is the
median over repeated calls of the whole method, from two uint8 frames to flow *and* uncertainty (for the classical
methods: both directions).
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ajna import analysis
from ajna.baselines import FlowMethod
from ajna.calibration.held_out import HeldOut
from ajna.data.dataset import FlowDataset, check_names
from ajna.data.frame_pair import FramePair
from ajna.metrics import (
    AUSE,
    EndPointError,
    FlAll,
    MotionBoundaryAUC,
    OcclusionAUC,
    OutlierRate,
    Pearson,
    Sparsification,
    SparsificationCurves,
    Spearman,
    motion_boundaries,
)
from ajna.pooled_ratio import PooledRatio

# Motion far beyond what a network for a drone's frames is meant for (Sintel's market_5 holds |flow| up to 132 px, 32 px
# in the mean) would alone decide a mean end-point error over a handful of pairs. Such cases tell about uncertainty only
# and stay out of the mean of the error figures.
UNCERTAINTY_ONLY = frozenset({"sintel_market5_final_0002"})

# Figures in pixels, and shares of pixels over a limit in pixels.
ERROR_FIGURES = (
    "epe",
    "zero_epe",
    "ratio",
    "fl_all",
    "outlier_1px",
    "outlier_3px",
    "outlier_5px",
    "ece_px",
    "width_90_px",
)

#: figures over the pixels of all cases -> those of a case
POOLED = {
    "pooled_boundary_ratio": "expected_boundary_ratio",
    "pooled_error_boundary_ratio": "error_boundary_ratio",
}

INTERVAL_LEVEL = 0.9  # of the coverage per case
DENSE_SHARE = 0.5  # of pixels with ground truth: with fewer it does not show where motion jumps


@dataclass(frozen=True)
class Scores:
    """Figures of one case or of a mean row; None where there is no ground truth, no mask, or nothing defined."""

    epe: float | None = None  # mean end-point error, pixels at the scored size
    zero_epe: float | None = None  # the same of zero flow: the mean true motion
    ratio: float | None = None  # epe / zero_epe; in a mean row the ratio of the two means
    fl_all: float | None = None  # fraction of pixels off by over 3 px and 5 %
    outlier_1px: float | None = None  # fraction of pixels off by over 1 px
    outlier_3px: float | None = None
    outlier_5px: float | None = None
    ause: float | None = None  # area under the sparsification error
    ause_fl: float | None = None  # the same of the share of KITTI's outliers
    rho: float | None = None  # Spearman correlation of uncertainty norm and end-point error
    pearson: float | None = None  # their linear correlation (paper Eq. 9)
    occlusion_auc: float | None = None  # ROC AUC of the uncertainty norm for the occlusion mask
    motion_boundary_auc: float | None = None  # the same for motion boundaries
    boundary_ratio: float | None = None  # median uncertainty there and at hidden pixels over that of textured surfaces
    expected_boundary_ratio: float | None = None  # the same of the expected error, where a method gives one
    error_boundary_ratio: float | None = None  # the same of the actual error, where it is known
    pooled_boundary_ratio: float | None = None  # expected_boundary_ratio over the pixels of all cases: mean rows only
    pooled_error_boundary_ratio: float | None = None  # and so error_boundary_ratio
    ece_px: float | None = None  # expected calibration error of the expected error; calibrated models only
    coverage_90: float | None = None  # share of flow components inside their 90 % interval; calibrated models only
    width_90_px: float | None = None  # mean width of these intervals, pixels
    run_time_ms: float | None = None  # median


@dataclass
class MethodReport:
    """What one method scored."""

    cases: dict[str, Scores] = field(default_factory=dict)
    curves: SparsificationCurves | None = None  # mean over the cases with ground truth
    run_times_ms: list[float] = field(default_factory=list)  # every timed call, `repeats` a case
    pooled: dict[str, PooledRatio] = field(default_factory=lambda: {name: PooledRatio() for name in POOLED})
    calibration: HeldOut | None = None  # over all cases with ground truth; calibrated models only
    mean: Scores = field(default_factory=Scores)
    mean_without_excluded: Scores | None = None

    def pooled_ratios(self) -> dict[str, float | None]:
        """The figures POOLED, over the pixels of all cases but those left out."""
        return {figure: pooled.ratio for figure, pooled in self.pooled.items()}


@dataclass
class Evaluation:
    """What all methods scored on one data set."""

    size: tuple[int, int] | None  # (width, height), or None for each pair's own
    methods: dict[str, MethodReport]
    uncertainty_only: tuple[str, ...] = ()  # present cases that stay out of the means of the error figures
    excluded: tuple[str, ...] = ()  # cases left out of `mean_without_excluded`
    bad: dict[str, str] = field(default_factory=dict)  # cases that cannot be read (with skip_bad), and why

    def to_json(self) -> dict[str, Any]:
        """Plain keys, numbers, null for undefined."""
        return {
            "size": list(self.size) if self.size else None,
            "uncertainty_only_cases": list(self.uncertainty_only),
            "excluded_cases": list(self.excluded),
            "bad_cases": self.bad,
            "methods": {
                name: {
                    "cases": {case: asdict(scores) for case, scores in report.cases.items()},
                    "mean": asdict(report.mean),
                    "mean_without_excluded": report.mean_without_excluded and asdict(report.mean_without_excluded),
                    "calibration": report.calibration and report.calibration.to_json(),
                }
                for name, report in self.methods.items()
            },
        }


OnCase = Callable[[str, FramePair, Any, Scores], None]


def evaluate(
    dataset: FlowDataset,
    methods: Mapping[str, FlowMethod],
    *,
    size: tuple[int, int] | None = (320, 240),
    exclude: Iterable[str] = (),
    uncertainty_only: Iterable[str] = UNCERTAINTY_ONLY,
    repeats: int = 3,
    on_case: OnCase | None = None,
) -> Evaluation:
    """Run every method on every pair and score it.

    Args:
        methods: name -> callable(frame1, frame2) that gives `.flow` and `.uncertainty` [H, W, 2].
        size: (width, height) at which all is run and scored; None for each pair's own size.
        exclude: cases that are scored but left out of a second mean, `mean_without_excluded`.
        uncertainty_only: cases left out of the means of the error figures (ERROR_FIGURES).
        repeats: timed calls per case, after one that is not timed.
        on_case: called with (method name, resized pair, field, scores) after each case, e.g. to draw pictures.

    Raises:
        ValueError: an unknown case in `exclude`, or an unreadable pair (with the data set's `skip_bad`: no readable).
        RuntimeError: a method returned values that are not finite or of the wrong shape.
    """
    excluded = tuple(exclude)
    check_names(excluded, dataset.names, dataset.root)
    if repeats < 1:
        raise ValueError(f"repeats={repeats} leaves nothing to time; use at least 1.")
    left_out = tuple(name for name in dataset.names if name in set(uncertainty_only))
    reports = {name: MethodReport() for name in methods}
    curves = {name: Sparsification() for name in methods}
    for native in dataset.pairs():
        pair = native if size is None else native.resized(*size)
        for name, method in methods.items():
            result, times_ms = _run(name, method, pair, repeats)
            counted = pair.name not in {*left_out, *excluded}
            scores = _score(pair, result, statistics.median(times_ms), curves[name], reports[name], counted)
            reports[name].run_times_ms.extend(times_ms)
            reports[name].cases[pair.name] = scores
            if on_case is not None:
                on_case(name, pair, result, scores)
    if len(dataset.bad) == len(dataset):
        raise dataset.none_left()
    for name, report in reports.items():
        if any(scores.ause is not None for scores in report.cases.values()):
            report.curves = curves[name].compute()
        pooled = report.pooled_ratios()  # without the excluded, here and there
        report.mean = replace(mean_scores(report.cases, without_errors=left_out), **pooled)
        if excluded:
            rest = {case: scores for case, scores in report.cases.items() if case not in excluded}
            mean = mean_scores(rest, without_errors=left_out)
            report.mean_without_excluded = replace(mean, **pooled)
    return Evaluation(size, reports, left_out, excluded, dict(dataset.bad))


def mean_scores(cases: Mapping[str, Scores], without_errors: Iterable[str] = ()) -> Scores:
    """Mean over the cases that have a figure; `run_time_ms` is the median, `ratio` the ratio of the means."""
    skipped = set(without_errors)
    means: dict[str, float | None] = {}
    for figure in (item.name for item in fields(Scores)):
        values = [
            value
            for case, scores in cases.items()
            if (value := getattr(scores, figure)) is not None and not (figure in ERROR_FIGURES and case in skipped)
        ]
        average = statistics.median if figure == "run_time_ms" else statistics.fmean
        means[figure] = average(values) if values else None
    means["ratio"] = _ratio(means["epe"], means["zero_epe"])
    return Scores(**means)


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def _run(name: str, method: FlowMethod, pair: FramePair, repeats: int) -> tuple[Any, list[float]]:
    result = method(pair.frame1, pair.frame2)
    expected = (*pair.frame1.shape[:2], 2)
    for part in ("flow", "uncertainty"):
        values = np.asarray(getattr(result, part))
        if values.shape != expected:
            raise RuntimeError(
                f"method '{name}' gave {part} of shape {values.shape} for '{pair.name}', not {expected}."
            )
        if not np.isfinite(values).all():
            bad = int((~np.isfinite(values)).sum())
            raise RuntimeError(
                f"method '{name}' gave {bad} values of {part} that are not finite for '{pair.name}'; "
                "it cannot be scored."
            )
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        method(pair.frame1, pair.frame2)
        times.append(1e3 * (time.perf_counter() - start))
    return result, times


def _score(
    pair: FramePair, result: Any, run_time_ms: float, curves: Sparsification, report: MethodReport, counted: bool
) -> Scores:
    uncertainty = _batch(result.uncertainty)
    if pair.flow is None or pair.valid is None:
        auc = None if pair.occlusion is None else OcclusionAUC()(uncertainty, torch.from_numpy(pair.occlusion)[None])
        return Scores(occlusion_auc=_defined(auc), run_time_ms=run_time_ms)
    prediction, target = _batch(result.flow), _batch(pair.flow)
    valid = torch.from_numpy(pair.valid)[None]
    auc = None
    if pair.occlusion is not None:
        auc = OcclusionAUC()(uncertainty, torch.from_numpy(pair.occlusion)[None], valid)
    if pair.motion_boundary is not None:
        boundary = torch.from_numpy(pair.motion_boundary)[None]
    else:
        boundary = motion_boundaries(target, valid)
    epe = _defined(EndPointError()(prediction, target, valid))
    zero_epe = _defined(EndPointError()(torch.zeros_like(target), target, valid))
    return Scores(
        epe=epe,
        zero_epe=zero_epe,
        ratio=_ratio(epe, zero_epe),
        fl_all=_defined(FlAll()(prediction, target, valid)),
        outlier_1px=_defined(OutlierRate(1.0)(prediction, target, valid)),
        outlier_3px=_defined(OutlierRate(3.0)(prediction, target, valid)),
        outlier_5px=_defined(OutlierRate(5.0)(prediction, target, valid)),
        ause=_defined(curves(prediction, target, uncertainty, valid).ause),
        ause_fl=_defined(AUSE(of="fl")(prediction, target, uncertainty, valid)),
        rho=_defined(Spearman()(prediction, target, uncertainty, valid)),
        pearson=_defined(Pearson()(prediction, target, uncertainty, valid)),
        occlusion_auc=_defined(auc),
        motion_boundary_auc=_defined(MotionBoundaryAUC()(uncertainty, boundary, valid)),
        **_boundary_ratios(pair, boundary[0].numpy(), result, report.pooled if counted else {}),
        **_calibration_scores(prediction, target, valid, result, report),
        run_time_ms=run_time_ms,
    )


def _boundary_ratios(
    pair: FramePair, boundary: NDArray[np.bool_], result: Any, pooled: Mapping[str, PooledRatio]
) -> dict[str, float]:
    """See `analysis.boundary_ratio`; without those not defined. Where ground truth is too sparse to show where motion
    jumps, what the mask says to be hidden counts alone; empty without a mask.

    A ratio depends on the unit: the paper's Y goes about with the root of the error that it stands for, so only the
    expected error's compares with the actual error's, and with that of methods whose uncertainty is in pixels.
    """
    if pair.flow is None or pair.valid is None:
        return {}
    if pair.valid.mean() < DENSE_SHARE:
        if pair.occlusion is None:
            return {}
        boundary = np.zeros_like(boundary)
    maps = {
        "boundary_ratio": result.uncertainty,
        "expected_boundary_ratio": getattr(result, "expected_error", None),
        "error_boundary_ratio": np.where(pair.valid[..., None], result.flow - pair.flow, np.nan),
    }
    sizes = {name: np.linalg.norm(np.asarray(given), axis=2) for name, given in maps.items() if given is not None}
    regions = analysis.boundary_regions(pair.frame1, boundary, pair.occlusion)
    for figure, one in pooled.items():
        if (size := sizes.get(POOLED[figure])) is not None:
            one.add(*(size[region] for region in regions))
    ratios = {name: analysis.boundary_ratio(regions, size) for name, size in sizes.items()}
    return {name: ratio for name, ratio in ratios.items() if math.isfinite(ratio)}


def _calibration_scores(
    prediction: Tensor, target: Tensor, valid: Tensor, result: Any, report: MethodReport
) -> dict[str, float | None]:
    """The figures of one case of a calibrated model, which is also added to the report's; empty for other methods."""
    factors = getattr(result, "conformal", None)
    if factors is None or not valid.any():
        return {}
    within = factors.levels[0] <= INTERVAL_LEVEL <= factors.levels[-1]
    levels = sorted({*factors.levels, *([INTERVAL_LEVEL] if within else [])})
    if report.calibration is None:
        report.calibration = HeldOut(levels, factors)
    case = HeldOut(levels, factors)
    for figures in (case, report.calibration):
        figures.add(prediction[0], target[0], _batch(result.expected_error)[0], valid[0])
    scores = {"ece_px": _defined(case.reliability.ece)}
    if within:
        curve, place = case.coverage, levels.index(INTERVAL_LEVEL)
        scores |= {"coverage_90": _defined(curve.coverage[place]), "width_90_px": _defined(curve.width[place])}
    return scores


def _batch(array: NDArray[Any]) -> Tensor:
    """[H, W, 2] -> [1, 2, H, W]."""
    return torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1)[None]


def _defined(value: Tensor | None) -> float | None:
    """NaN, which here can only mean undefined (`_run` refuses methods that give NaN), becomes None."""
    return None if value is None or math.isnan(value.item()) else value.item()
