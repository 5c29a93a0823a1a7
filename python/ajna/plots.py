# SPDX-License-Identifier: MIT
"""Plots of what `ajna.analysis` finds: RGB uint8 [H, W, 3] like those of `ajna.viz`, no global plotting state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import ArrayLike, NDArray

from ajna import viz
from ajna.analysis import Intervals, PixelTable, Relation, correlations
from ajna.data.frame_pair import FramePair

RgbImage = NDArray[np.uint8]

_DPI = 100
_EXPECTED, _ACTUAL = "C1", "C0"
_FLOOR = 1e-2  # pixels, the smallest error that logarithmic axes show


def _figure(width: int, height: int) -> Figure:
    """A figure of so many pixels."""
    return Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white", layout="constrained")


def _rgb(figure: Figure) -> RgbImage:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _grid(figure: Figure, rows: int, columns: int, **options: Any) -> NDArray[Any]:
    return np.asarray(figure.subplots(rows, columns, squeeze=False, **options), dtype=object)


def _plain_ticks(place: Axes, low: float, high: float, least: float = 0.0) -> None:
    """Ticks 1, 2, 5 of every decade, and 0, from low to high; but none between 0 and `least`."""
    steps = [step * 10.0**power for power in range(-3, 4) for step in (1, 2, 5)]
    ticks = [tick for tick in (0.0, *steps) if low <= tick <= high and not 0 < tick < max(least, high / 200)]
    place.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    place.xaxis.set_minor_locator(NullLocator())


# --- maps ----------------------------------------------------------------------------------------------------------


def uncertainty_panel(pair: FramePair, field: Any, title: str = "", width: int = 1280) -> RgbImage:
    """Eight maps of one pair with ground truth: what is true, what is said of it, and what is said of itself.

    Upper row: frame 1, where it is hidden or at a depth boundary, true flow, flow. Lower row, in one colour scale:
    actual error, expected error, and the expected error of u and of v alone.

    Args:
        field: with `.flow` and `.expected_error`, [H, W, 2] in pixels.
        width: of the picture, pixels.

    Raises:
        ValueError: a pair without ground truth.
    """
    if pair.flow is None or pair.valid is None:
        raise ValueError(f"case '{pair.name}' has no ground truth to show beside the flow.")
    truth = np.where(pair.valid[..., None], pair.flow, np.nan)
    error = np.linalg.norm(field.flow - truth, axis=2)
    expected = np.asarray(field.expected_error)
    max_flow = viz.robust_scale(np.linalg.norm(truth, axis=2))
    max_error = viz.robust_scale(error, np.linalg.norm(expected, axis=2))
    pictures = [
        (pair.frame1, "frame 1"),
        (_masks(pair), "orange: hidden, blue: depth edge"),
        (viz.flow_to_image(truth, max_flow), f"true flow, up to {max_flow:g} px"),
        (viz.flow_to_image(field.flow, max_flow), "flow"),
        (viz.uncertainty_to_image(error, 0.0, max_error), f"actual error, mean {np.nanmean(error):.2f} px"),
        (
            viz.uncertainty_to_image(expected, 0.0, max_error),
            f"expected error, mean {np.linalg.norm(expected, axis=2).mean():.2f} px",
        ),
        (viz.uncertainty_to_image(expected[..., 0], 0.0, max_error), "expected error of u alone"),
        (viz.uncertainty_to_image(expected[..., 1], 0.0, max_error), "expected error of v alone"),
    ]
    columns, rows = pair.size
    map_height = 0.94 * width / 4 * rows / columns
    figure = _figure(width, round(2 * (map_height + 26)) + (30 if title else 0))
    axes = _grid(figure, 2, 4)
    for place, (picture, name) in zip(axes.flat, pictures, strict=True):
        place.imshow(picture, interpolation="antialiased")
        place.set_axis_off()
        place.set_title(name, fontsize=min(9.0, width / 110))
    colors = ScalarMappable(Normalize(0.0, max_error), viz.UNCERTAINTY_COLORMAP)
    bar = figure.colorbar(colors, ax=list(axes[1]), fraction=0.02, pad=0.01)
    bar.set_label("px", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    return _rgb(figure)


def _masks(pair: FramePair) -> RgbImage:
    """Frame 1, pale and grey, with its occlusion in orange and its depth boundaries in blue."""
    grey = pair.frame1.mean(axis=2, keepdims=True)
    image = np.repeat(128 + grey / 2, 3, axis=2)
    for mask, color in ((pair.occlusion, (255, 127, 14)), (pair.motion_boundary, (31, 80, 220))):
        if mask is not None:
            image[mask] = color
    return image.astype(np.uint8)


# --- correlation ---------------------------------------------------------------------------------------------------


def correlation_plot(table: PixelTable, title: str = "") -> RgbImage:
    """Where pixels lie by expected and actual error (logarithmic), of the norm and of each axis, with Eq. 9 above."""
    figure = _figure(1280, 440)
    actual = np.abs(table.deviation)
    columns = [
        ("both axes (2-norm)", table.expected_norm, table.error),
        ("u", table.expected[:, 0], actual[:, 0]),
        ("v", table.expected[:, 1], actual[:, 1]),
    ]
    high = viz.nice_scale(max(float(np.quantile(table.error, 0.9999)), float(table.expected_norm.max())))
    edges = np.geomspace(_FLOOR, high, 81)
    axes = _grid(figure, 1, 3, sharex=True, sharey=True)[0]
    for place, (name, expected, error) in zip(axes, columns, strict=True):
        counts = np.histogram2d(np.maximum(expected, _FLOOR), np.maximum(error, _FLOOR), bins=(edges, edges))[0]
        drawn = place.pcolormesh(edges, edges, np.where(counts > 0, counts, np.nan).T, norm=LogNorm(), cmap="viridis")
        place.plot((_FLOOR, high), (_FLOOR, high), color="C3", linewidth=1, label="expected = actual")
        place.set_xscale("log")
        place.set_yscale("log")
        rho = correlations(expected, error)
        place.set_title(f"{name}: Pearson {rho.pearson:.2f} (Eq. 9), Spearman {rho.spearman:.2f}", fontsize=10)
        place.set_xlabel("expected error, px")
    axes[0].set_ylabel("actual error, px")
    axes[0].legend(fontsize=9, loc="upper left")
    figure.colorbar(drawn, ax=list(axes), fraction=0.02, pad=0.01).set_label("pixels")
    if title:
        figure.suptitle(title, fontsize=11)
    return _rgb(figure)


# --- relations -----------------------------------------------------------------------------------------------------


def reliability_plot(curves: Mapping[str, Relation], title: str = "Reliability") -> RgbImage:
    """Observed against expected error per bin, logarithmic; on the diagonal the network means what it says."""
    figure = _figure(620, 520)
    place: Axes = figure.subplots()
    ends = [np.concatenate([curve.expected, curve.actual]) for curve in curves.values()]
    low = max(min(float(values.min()) for values in ends) / 1.3, _FLOOR / 10)
    high = max(float(values.max()) for values in ends) * 1.3
    place.plot((low, high), (low, high), color="grey", linewidth=1, linestyle="--", label="observed = expected")
    for index, (name, curve) in enumerate(curves.items()):
        place.plot(curve.expected, curve.actual, marker="o", markersize=4, color=f"C{index % 10}", label=name)
    place.set_xscale("log")
    place.set_yscale("log")
    place.set_xlim(low, high)
    place.set_ylim(low, high)
    place.set_xlabel("expected error, px (mean of the bin)")
    place.set_ylabel("observed error, px")
    place.set_title(title, fontsize=11)
    place.grid(alpha=0.3, which="both")
    place.legend(fontsize=9)
    return _rgb(figure)


def relations_plot(
    relations: Mapping[str, Relation], logarithmic: tuple[str, ...] = (), title: str = "", columns: int = 3
) -> RgbImage:
    """Expected and actual error against several quantities, a panel each.

    Args:
        relations: label of the horizontal axis (with its unit) -> :class:`ajna.analysis.Relation`.
        logarithmic: labels whose axis is logarithmic.
    """
    rows = -(-len(relations) // columns)
    figure = _figure(430 * columns, 330 * rows + (30 if title else 0))
    axes = _grid(figure, rows, columns)
    for place in axes.flat[len(relations) :]:
        place.set_axis_off()
    for place, (name, curve) in zip(axes.flat, relations.items(), strict=False):
        place.plot(curve.value, curve.actual, marker="o", markersize=3.5, color=_ACTUAL, label="actual")
        place.plot(curve.value, curve.expected, marker="s", markersize=3.5, color=_EXPECTED, label="expected")
        if name in logarithmic:
            place.set_xscale("symlog", linthresh=1.0)
            _plain_ticks(place, 0.0 if curve.value.min() < 1 else curve.value.min(), curve.value.max(), least=0.5)
        place.set_ylim(bottom=0)
        place.set_xlabel(name)
        place.set_ylabel("error, px")
        place.grid(alpha=0.3)
        place.legend(fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11)
    return _rgb(figure)


def regions_plot(regions: Mapping[str, Mapping[str, float]], title: str = "") -> RgbImage:
    """Bars of actual and expected error by region, as :func:`ajna.analysis.by_region` gives them."""
    figure = _figure(760, 420)
    place: Axes = figure.subplots()
    x = np.arange(len(regions))
    for shift, name, color in ((-0.2, "actual", _ACTUAL), (0.2, "expected", _EXPECTED)):
        bars = place.bar(x + shift, [region[name] for region in regions.values()], 0.38, color=color, label=name)
        place.bar_label(bars, fmt="%.2f", fontsize=8)
    place.set_xticks(x, [f"{name}\n{region['share']:.0%} of pixels" for name, region in regions.items()], fontsize=9)
    place.set_ylabel("mean error, px")
    place.set_title(title, fontsize=11)
    place.legend(fontsize=9)
    return _rgb(figure)


def aperture_plot(curve: Relation, title: str = "Per axis: the aperture problem") -> RgbImage:
    """What :func:`ajna.analysis.aperture` gives: the ratio of the two axes' errors against that of the texture."""
    figure = _figure(620, 430)
    place: Axes = figure.subplots()
    place.axhline(0, color="grey", linewidth=1)
    place.axvline(0, color="grey", linewidth=1)
    place.plot(curve.value, curve.actual, marker="o", markersize=4, color=_ACTUAL, label="actual")
    place.plot(curve.value, curve.expected, marker="s", markersize=4, color=_EXPECTED, label="expected")
    place.set_xlabel("log2 (derivative in y / derivative in x): texture seen by v only  →")
    place.set_ylabel("log2 (error of u / error of v)")
    place.set_title(title, fontsize=11)
    place.grid(alpha=0.3)
    place.legend(fontsize=9)
    return _rgb(figure)


def intervals_plot(found: Intervals, local: tuple[ArrayLike, ArrayLike], level: float, title: str = "") -> RgbImage:
    """Left: share of held-out pixels inside the intervals against the level. Right: that share by expected error.

    Args:
        local: (expected error, share inside) per bin at `level`, as :func:`ajna.analysis.coverage_by` gives it.
    """
    figure = _figure(1000, 430)
    left, right = _grid(figure, 1, 2)[0]
    left.plot((0, 1), (0, 1), color="grey", linewidth=1, linestyle="--", label="held = promised")
    for axis, name in enumerate(("u", "v")):
        left.plot(found.level, found.coverage[:, axis], marker="o", markersize=4, color=f"C{axis}", label=name)
    left.set_xlim(found.level.min() - 0.05, 1)
    left.set_ylim(found.level.min() - 0.05, 1)
    left.set_xlabel("level of the interval")
    left.set_ylabel("share of held-out pixels inside")
    right.axhline(level, color="grey", linewidth=1, linestyle="--", label="promised")
    right.plot(*(np.asarray(values) for values in local), marker="o", markersize=4, color=_EXPECTED, label="held")
    right.set_xscale("log")
    shown = np.asarray(local[0])
    _plain_ticks(right, shown.min() / 1.1, shown.max() * 1.1)
    right.set_ylim(min(0.5, float(np.min(np.asarray(local[1])))) - 0.05, 1.02)
    right.set_xlabel("expected error, px")
    right.set_ylabel(f"share inside the {level:.0%} interval")
    for place in (left, right):
        place.grid(alpha=0.3)
        place.legend(fontsize=9, loc="lower right")
    if title:
        figure.suptitle(title, fontsize=11)
    return _rgb(figure)
