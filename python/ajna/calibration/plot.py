# SPDX-License-Identifier: MIT
"""The picture of calibration: reliability and coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ajna.calibration.held_out import HeldOut

_DPI = 100
_LEAST_WEIGHT = 5e-4  # bins with a smaller share of the pixels are noise: not drawn


def reliability_plot(figures: Mapping[str, HeldOut], title: str = "") -> NDArray[np.uint8]:
    """Observed against expected error per bin, the share of pixels per bin, and the coverage of intervals by level.

    Args:
        figures: name -> figures over images, for example before and after a calibration.

    Returns:
        RGB uint8 [H, W, 3].
    """
    figure = Figure(figsize=(10.4, 5.2), dpi=_DPI, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=(4, 1), width_ratios=(1.15, 1))
    errors, counts = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    coverage = figure.add_subplot(grid[:, 1])
    ends, lowest = [], 0.45
    for index, (name, held_out) in enumerate(figures.items()):
        color, curve, intervals = f"C{index % 10}", held_out.reliability, held_out.coverage
        shown = (curve.weight >= _LEAST_WEIGHT).numpy()
        expected, observed = curve.expected.numpy()[shown], curve.observed.numpy()[shown]
        label = f"{name}: ECE {curve.ece.item():.3f} px"
        style: dict[str, Any] = {"color": color, "marker": "o", "markersize": 4, "linewidth": 1.2}
        errors.plot(expected, observed, label=label, **style)
        counts.plot(expected, 100 * curve.weight.numpy()[shown], color=color, linewidth=1.2)
        label = f"{name}: {held_out.intervals_from}"
        coverage.plot(intervals.levels.numpy(), intervals.coverage.numpy(), label=label, **style)
        ends += [expected, observed]
        lowest = min(lowest, float(intervals.coverage.min()) - 0.03)
    values = np.concatenate(ends)
    values = values[values > 0]
    low, high = (values.min() / 1.3, values.max() * 1.3) if values.size else (0.1, 1.0)
    errors.plot([low, high], [low, high], color="grey", linestyle="--", linewidth=1, label="calibrated")
    errors.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    errors.set_ylabel("mean observed |error| per axis, px")
    errors.tick_params(labelbottom=False)
    counts.set(xscale="log", xlim=(low, high), ylim=(0, None), ylabel="% of pixels")
    counts.set_xlabel("expected error per axis, px")
    coverage.plot([0, 1], [0, 1], color="grey", linestyle="--", linewidth=1, label="as promised")
    coverage.set(xlim=(0.45, 1.01), ylim=(lowest, 1.01), xlabel="level of the interval")
    coverage.set_ylabel("share of flow components inside")
    for axes in (errors, coverage):
        axes.legend(frameon=False, fontsize=9, loc="upper left")
    for axes in (errors, counts, coverage):
        axes.grid(alpha=0.3)
    if title:
        figure.suptitle(title, fontsize=11)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
