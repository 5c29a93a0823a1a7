# SPDX-License-Identifier: MIT
"""Pictures of flow and uncertainty: plain RGB uint8 arrays [H, W, 3], drawn without any global plotting state.

Flow is shown in the Middlebury colour code (Baker et al.): hue is the direction of motion, saturation its length; white
is no motion. Uncertainty is shown from dark blue (certain) over magenta to yellow (uncertain). The paper calls this
"inverse plasma, where blue color represents lower uncertainty [...] and yellow represents higher uncertainty": inverse
to its *depth* pictures, in which blue is far, the larger value. Applied to a map of uncertainty this is matplotlib's
``plasma`` as it is, not ``plasma_r``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

RgbImage = NDArray[np.uint8]

UNCERTAINTY_COLORMAP = "plasma"
UNKNOWN_FLOW = 1e9  # Middlebury: components beyond mean "unknown"
ROBUST_PERCENTILE = 99.0

# Middlebury's wheel: how many steps lie between one corner of the RGB cube and the next, in order of angle.
_WHEEL_STEPS = (15, 6, 4, 11, 13, 6)
_WHEEL_CORNERS = ((1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0))


class FieldLike(Protocol):
    """What a field must have to be drawn: ajna.FlowField, or anything with these maps [H, W, 2]."""

    @property
    def flow(self) -> Any: ...
    @property
    def expected_error(self) -> Any: ...


class Curve(NamedTuple):
    """One method's line in `sparsification_plot`; [K] each."""

    by_uncertainty: ArrayLike
    oracle: ArrayLike
    ause: float


# --- colours -------------------------------------------------------------------------------------------------------


def color_wheel() -> NDArray[np.float64]:
    """The Middlebury colour wheel: [55, 3] RGB in 0..1, by angle."""
    ends = np.cumsum((0, *_WHEEL_STEPS))
    corners = np.asarray(_WHEEL_CORNERS, dtype=np.float64)
    position = np.arange(ends[-1])
    return np.stack([np.interp(position, ends, corners[:, channel]) for channel in range(3)], axis=-1)


def nice_scale(largest: float) -> float:
    """The next of 1, 2, 3, 4, 5, 6, 8 times a power of ten at or above `largest`: a scale that reads well.

    1 where `largest` is zero, negative or not finite.
    """
    if not np.isfinite(largest) or largest <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(largest))
    for step in (1, 2, 3, 4, 5, 6, 8):
        if largest <= step * power * (1 + 1e-9):
            return float(step * power)
    return float(10 * power)


def robust_scale(*maps: ArrayLike) -> float:
    """A scale that covers 99 % of the finite values of every map given, rounded up by `nice_scale`."""
    largest = 0.0
    for values in maps:
        known = np.asarray(values, dtype=np.float64)
        known = known[np.isfinite(known)]
        if known.size:
            largest = max(largest, float(np.percentile(known, ROBUST_PERCENTILE)))
    return nice_scale(largest)


def _magnitude(flow: ArrayLike, name: str) -> NDArray[np.float64]:
    """2-norm of [H, W, 2]; NaN where unknown."""
    array = np.asarray(flow, dtype=np.float64)
    if array.ndim != 3 or array.shape[2] != 2:
        raise ValueError(f"{name} has shape {array.shape}; pass [height, width, 2].")
    known: NDArray[np.bool_] = np.all(np.abs(array) <= UNKNOWN_FLOW, axis=2)  # false for NaN, too
    return np.where(known, np.hypot(*np.moveaxis(np.where(known[..., None], array, 0.0), 2, 0)), np.nan)


def _scalar_map(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 2:
        return array
    return _magnitude(array, name)


def flow_to_image(flow: ArrayLike, max_flow: float | None = None) -> RgbImage:
    """Flow [H, W, 2] in pixels to RGB [H, W, 3] uint8 in the Middlebury colour code.

    Args:
        flow: float; unknown vectors (not finite, or beyond 1e9) become black.
        max_flow: the length in pixels that is fully saturated; longer vectors are darkened. Without it `robust_scale`
            of this very flow: give a number to compare pictures.
    """
    length = _magnitude(flow, "flow")
    if max_flow is None:
        max_flow = robust_scale(length)
    if not (np.isfinite(max_flow) and max_flow > 0):
        raise ValueError(f"max_flow={max_flow} must be a positive length in pixels.")
    known = np.isfinite(length)
    u, v = (np.where(known, component, 0.0) for component in np.moveaxis(np.asarray(flow, dtype=np.float64), 2, 0))
    radius = np.where(known, length, 0.0)[..., None] / max_flow

    wheel = color_wheel()
    position = (np.arctan2(-v, -u) / np.pi + 1.0) / 2.0 * (len(wheel) - 1)
    lower = np.floor(position).astype(np.intp)
    part = (position - lower)[..., None]
    hue = (1.0 - part) * wheel[lower] + part * wheel[(lower + 1) % len(wheel)]
    color = np.where(radius <= 1.0, 1.0 - radius * (1.0 - hue), 0.75 * hue)
    return np.floor(255.0 * np.where(known[..., None], color, 0.0) + 1e-9).astype(np.uint8)


def uncertainty_to_image(values: ArrayLike, vmin: float = 0.0, vmax: float | None = None) -> RgbImage:
    """A map of uncertainty or expected error to RGB [H, W, 3] uint8: dark blue is certain, yellow uncertain.

    Args:
        values: [H, W], or [H, W, 2] per axis, of which the 2-norm is shown; not finite becomes black.
        vmin, vmax: values of the two ends; without vmax `robust_scale` of this very map (at least above vmin).
    """
    scalar = _scalar_map(values, "uncertainty")
    vmax = max(robust_scale(scalar), vmin + 1e-12) if vmax is None else vmax
    if not vmax > vmin:
        raise ValueError(f"vmax={vmax} must lie above vmin={vmin}.")
    known = np.isfinite(scalar)
    position = (np.where(known, scalar, vmin) - vmin) / (vmax - vmin)
    image = matplotlib.colormaps[UNCERTAINTY_COLORMAP](np.clip(position, 0.0, 1.0), bytes=True)[..., :3]
    return np.where(known[..., None], image, 0).astype(np.uint8)


def wheel_image(size: int = 151) -> NDArray[np.uint8]:
    """The legend: RGBA [size, size, 4], the colour at each place being that of a motion from the centre to there."""
    axis = np.linspace(-1.0, 1.0, size)
    u, v = np.meshgrid(axis, axis)
    inside = np.hypot(u, v) <= 1.0
    rgb = flow_to_image(np.stack([u, v], axis=-1) * np.where(inside, 1.0, 0.0)[..., None], max_flow=1.0)
    return np.concatenate([rgb, np.where(inside, 255, 0).astype(np.uint8)[..., None]], axis=-1)


def anaglyph(frame1: ArrayLike, frame2: ArrayLike) -> RgbImage:
    """Both frames in one picture [H, W, 3] uint8: frame 1 in red, frame 2 in cyan; what moved shows coloured rims."""
    grey1, grey2 = (
        _frame(frame, name) @ (0.299, 0.587, 0.114) for frame, name in ((frame1, "frame1"), (frame2, "frame2"))
    )
    return np.stack([grey1, grey2, grey2], axis=-1).round().astype(np.uint8)


def _frame(frame: ArrayLike, name: str) -> RgbImage:
    array = np.asarray(frame)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
        raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}; pass RGB uint8 [height, width, 3].")
    return array


# --- figures -------------------------------------------------------------------------------------------------------

_DPI = 100
_PANEL_AREA = 480 * 360  # pixels; the shape follows the frames
_WIDE = 2.0  # frames wider than this are stacked
_GAP, _TITLE, _GUTTER = 14, 26, 118  # pixels
_TEXT = 10.5  # points


class _Canvas:
    """A figure addressed in pixels from the top left, so that nothing overlaps by accident."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
        self._agg = FigureCanvasAgg(self.figure)

    def axes(self, x: float, y: float, width: float, height: float) -> Axes:
        box = (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box)

    def text(self, x: float, y: float, text: str, fit: float, **style: Any) -> None:
        """One line at the usual size, or smaller where it would be wider than `fit` pixels."""
        artist = self.figure.text(x / self.width, 1 - y / self.height, text, fontsize=_TEXT, va="center", **style)
        renderer, size = self._agg.get_renderer(), _TEXT
        # Hinting makes the width a step function of the size: one division may not be enough.
        while (width := artist.get_window_extent(renderer).width) > fit and size > 1:
            size *= 0.98 * fit / width
            artist.set_fontsize(size)

    def panel(self, x: float, y: float, width: float, height: float, image: NDArray[np.uint8], title: str) -> None:
        """An image with its title above; `y` is the top of the title."""
        self.text(x, y + _TITLE / 2, title, fit=width)
        axes = self.axes(x, y + _TITLE, width, height)
        axes.imshow(image, aspect="auto", interpolation="antialiased")
        axes.set_axis_off()

    def rgb(self) -> RgbImage:
        self._agg.draw()
        return np.asarray(self._agg.buffer_rgba())[..., :3].copy()


def overview(
    frame1: ArrayLike,
    frame2: ArrayLike,
    field: FieldLike,
    ground_truth: ArrayLike | None = None,
    *,
    title: str = "",
    max_flow: float | None = None,
    max_error: float | None = None,
    error_label: str = "expected error",
) -> RgbImage:
    """One picture of a frame pair and what was found: frames, flow with its wheel, expected error with a bar in pixels.

    Args:
        frame1, frame2: RGB uint8 [H, W, 3].
        field: with `.flow` and `.expected_error`, float [H, W, 2] in pixels (of the latter the 2-norm is shown).
        ground_truth: flow [H, W, 2] in pixels, NaN where unknown: adds the true flow and the actual error, in the same
            colour scales as what the network says.
        title: a line above all.
        max_flow, max_error: ends of the scales in pixels; by default they cover 99 % of what is shown.
        error_label: what the second row shows, where it is not the network's expected error.

    Returns:
        RGB uint8; about 1150 pixels wide without ground truth.
    """
    first, second = _frame(frame1, "frame1"), _frame(frame2, "frame2")
    flow, error = np.asarray(field.flow), _scalar_map(field.expected_error, "expected_error")
    shapes = {"frame2": second.shape[:2], "flow": flow.shape[:2], "expected_error": error.shape}
    truth = None if ground_truth is None else np.asarray(ground_truth, dtype=np.float64)
    if truth is not None:
        shapes["ground_truth"] = truth.shape[:2]
    for name, shape in shapes.items():
        if shape != first.shape[:2]:
            raise ValueError(f"{name} is {shape} (height, width), but frame1 is {first.shape[:2]}; sizes must agree.")

    lengths, errors = [_magnitude(flow, "flow")], [error]
    if truth is not None:
        lengths.append(_magnitude(truth, "ground_truth"))
        errors.append(np.where(np.isfinite(lengths[1]), np.linalg.norm(flow - truth, axis=2), np.nan))
    max_flow = robust_scale(*lengths) if max_flow is None else max_flow
    max_error = robust_scale(*errors) if max_error is None else max_error
    pictures = [
        [(first, "frame 1"), (anaglyph(first, second), "both frames (red-cyan anaglyph)")],
        [
            (flow_to_image(flow, max_flow), f"optical flow{_mean(lengths[0])}"),
            (uncertainty_to_image(error, 0.0, max_error), f"{error_label}{_mean(error)}"),
        ],
    ]
    if truth is not None:
        note = "" if np.isfinite(lengths[1]).all() else ", black: unknown"
        pictures.append(
            [
                (flow_to_image(truth, max_flow), f"true flow{_mean(lengths[1], note)}"),
                (uncertainty_to_image(errors[1], 0.0, max_error), f"actual error{_mean(errors[1], note)}"),
            ]
        )
    return _draw_grid(pictures, first.shape[1] / first.shape[0], title, max_flow, max_error)


def _mean(values: NDArray[np.float64], note: str = "") -> str:
    known = values[np.isfinite(values)]
    return f" (mean {known.mean():.2f} px{note})" if known.size else " (unknown)"


def _draw_grid(
    pictures: list[list[tuple[RgbImage, str]]], aspect: float, title: str, max_flow: float, max_error: float
) -> RgbImage:
    """Pairs of (picture, its title) side by side, or below each other where frames are wide; legends at the right."""
    width, height = round((_PANEL_AREA * aspect) ** 0.5), round((_PANEL_AREA / aspect) ** 0.5)
    grid = pictures if aspect > _WIDE else [list(row) for row in zip(*pictures, strict=True)]
    head = _TITLE if title else 0
    gutter = _GAP + len(grid[0]) * (width + _GAP)
    tops = [head + _GAP / 2 + row * (height + _TITLE + _GAP / 2) for row in range(len(grid))]
    canvas = _Canvas(gutter + _GUTTER, round(tops[-1] + height + _TITLE + _GAP))
    if title:
        canvas.text(_GAP, _GAP / 2 + head / 2, title, fit=canvas.width - 2 * _GAP, weight="bold")
    for top, row in zip(tops, grid, strict=True):
        for column, (image, name) in enumerate(row):
            canvas.panel(_GAP + column * (width + _GAP), top, width, height, image, name)
    _draw_wheel(canvas, gutter, tops[0], height, max_flow)
    _draw_bar(canvas, gutter, tops[1], height, max_error)
    return canvas.rgb()


def _draw_wheel(canvas: _Canvas, x: float, y: float, height: float, max_flow: float) -> None:
    size = min(_GUTTER - _GAP, height - 2 * _TITLE)
    canvas.text(x, y + _TITLE / 2, "flow towards", fit=_GUTTER - _GAP)
    axes = canvas.axes(x, y + _TITLE, size, size)
    axes.imshow(wheel_image(), interpolation="antialiased")
    axes.set_axis_off()
    canvas.text(x + size / 2, y + _TITLE + size + _TITLE / 2, f"rim: {max_flow:g} px", fit=size, ha="center")


def _draw_bar(canvas: _Canvas, x: float, y: float, height: float, max_error: float) -> None:
    canvas.text(x, y + _TITLE / 2, "error", fit=_GUTTER - _GAP)
    axes = canvas.axes(x, y + _TITLE + 6, 16, height - 12)  # room for half a label at either end
    colors = ScalarMappable(Normalize(0.0, max_error), matplotlib.colormaps[UNCERTAINTY_COLORMAP])
    bar = canvas.figure.colorbar(colors, cax=axes)
    ticks = [max_error * quarter / 4 for quarter in range(5)]
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks[:-1]] + [f"≥ {max_error:.3g} px"])
    axes.tick_params(labelsize=_TEXT)


def sparsification_plot(curves: Mapping[str, Curve], title: str = "") -> RgbImage:
    """Sparsification curves of several methods as RGB uint8: solid by uncertainty, dashed the method's oracle.

    Args:
        curves: method -> Curve, as `ajna.metrics.Sparsification` computes them.
    """
    canvas = _Canvas(760, 520)
    axes = canvas.axes(70, 40, 660, 420)
    for index, (name, curve) in enumerate(curves.items()):
        by_uncertainty, oracle = np.asarray(curve.by_uncertainty), np.asarray(curve.oracle)
        removed = np.linspace(0.0, 1.0, by_uncertainty.size)
        color = f"C{index % 10}"
        # The last value, with no pixel left, is 0 by convention only: not drawn.
        axes.plot(removed[:-1], by_uncertainty[:-1], color=color, label=f"{name}: AUSE {curve.ause:.3f}")
        axes.plot(removed[:-1], oracle[:-1], color=color, linestyle="--", linewidth=1)
    axes.plot([], [], color="grey", linestyle="--", linewidth=1, label="oracle: by the actual error")
    axes.set_xlim(0, 1)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("fraction of pixels removed, most uncertain first", fontsize=_TEXT)
    axes.set_ylabel("mean error of the rest / mean error of all", fontsize=_TEXT)
    axes.tick_params(labelsize=_TEXT)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=_TEXT, loc="best", frameon=False)
    if title:
        axes.set_title(title, fontsize=_TEXT + 1)
    return canvas.rgb()
