# SPDX-License-Identifier: MIT
"""From trials to a row of a table: rates and means with bootstrap confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ajna.bootstrap import bootstrap_interval
from ajna.sim.episode import DETECTION_IOU, EpisodeResult

__all__ = ["bootstrap_interval", "summarize"]


def _entry(record: dict[str, Any], key: str, values: Sequence[float | None], scale: float = 1.0) -> None:
    known = [scale * value for value in values if value is not None]
    record[key] = float(np.mean(known)) if known else None
    record[f"{key}_ci"] = list(bootstrap_interval(known)) if known else None


def _median_speed(result: EpisodeResult) -> float | None:
    path = np.array(result.path, dtype=np.float64)
    if len(path) < 2:
        return None
    steps = np.diff(path, axis=0)
    return float(np.median(np.linalg.norm(steps[:, 1:], axis=1) / steps[:, 0]))


def summarize(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """The figures of one method in one world; each rate and mean has its 95 % interval beside it under ``..._ci``.

    success_rate: in [0, 1]. mean_speed_m_s: over successful trials, run-up and
    all; cruise_speed_m_s: likewise of their median speed. path_increase_percent: over trials in which both
    the method and true depth reached the goal. detection_rate: share of trials with IoU >= 0.5 on the frame that was
    acted on; detection_rate_best: on any frame from then on.
    safe_point_error_px, safe_point_error_same_px: mean over trials of their mean. run_time_ms: median over trials (its
    interval, too).
    frames_per_cpu_s: frames over the processor time of their trials, pictures, physics, method and judge together.

    Raises:
        ValueError: for no results.
    """
    if not results:
        raise ValueError("there are no trials to summarize")
    record: dict[str, Any] = {"world": results[0].world, "method": results[0].method, "trials": len(results)}
    _entry(record, "success_rate", [float(result.success) for result in results])
    _entry(record, "mean_speed_m_s", [r.mean_speed_m_s for r in results if r.success and r.path_length_m > 0])
    increases = [
        100 * (r.path_length_m / r.reference_path_length_m - 1)
        for r in results
        if r.success and r.reference_path_length_m is not None
    ]
    _entry(record, "path_increase_percent", increases)
    _entry(record, "safe_point_error_px", [r.safe_point_error_px for r in results])
    _entry(record, "safe_point_error_same_px", [r.safe_point_error_same_px for r in results])
    ious = [r.detection_iou for r in results if r.detection_iou is not None]
    _entry(record, "detection_rate", [float(iou >= DETECTION_IOU) for iou in ious])
    _entry(record, "detection_iou", ious)
    best = [r.best_iou for r in results if r.best_iou is not None]
    _entry(record, "detection_rate_best", [float(iou >= DETECTION_IOU) for iou in best])
    times = [r.run_time_ms for r in results if r.run_time_ms is not None]
    record["run_time_ms"] = float(np.median(times)) if times else None
    record["run_time_ms_ci"] = (
        list(bootstrap_interval(times, statistic=lambda s: np.median(s, axis=-1))) if times else None
    )
    # Where the vehicle is under way: half of the time it is faster than this.
    speeds = [_median_speed(result) for result in results if result.success]
    _entry(record, "cruise_speed_m_s", speeds)
    timed = [(result.frames, result.cpu_s) for result in results if result.cpu_s]
    seconds = sum(cpu_s for _, cpu_s in timed)
    record["frames_per_cpu_s"] = sum(frames for frames, _ in timed) / seconds if seconds else None
    reasons = sorted({result.reason for result in results})
    record["outcomes"] = {reason: sum(result.reason == reason for result in results) for reason in reasons}
    return record
