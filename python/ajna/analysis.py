# SPDX-License-Identifier: MIT
"""What the uncertainty goes with: pixel tables of error, expected error and scene properties, and figures from them.

Made for pairs with dense ground truth (`ajna.data.synthetic.SyntheticScenes`, or any `FramePair` that has it). A
:class:`PixelTable` keeps a random sample of each pair's pixels, so that it stays small over many pairs; every function
here works on it. `ajna.plots` draws the results.

Errors are of flow, in pixels. "Expected" is what the network says of itself (`FlowField.expected_error`), "actual" what
ground truth says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ajna import viz
from ajna.data.frame_pair import FramePair
from ajna.metrics import Sparsification, average_ranks, pearson_correlation

WINDOW = 9  # pixels, side of the square around a pixel in which texture is measured
MAX_DISTANCE = 24  # pixels, at which the distance to a depth boundary saturates
AT_PX = 2  # steps to a motion boundary that count as at it
AWAY_PX = 10  # ... and that count as away from it
FLAT_GREY = 4.0  # local contrast below which a place is flat, grey levels
LEAST_PX = 100  # pixels that a region needs for its figure to count
BORDER_PX = 8  # of the image, where motion leaves it
_LUMA = (0.299, 0.587, 0.114)

Map = NDArray[np.float64]
#: A pair and the field that a method gave for it: `.flow`, `.uncertainty`, `.expected_error`, [H, W, 2] each.
Answer: TypeAlias = tuple[FramePair, Any]


# --- what a pixel looks like ---------------------------------------------------------------------------------------


def image_gradient(frame: NDArray[np.uint8]) -> Map:
    """Central differences of the luma in x and y: RGB uint8 [H, W, 3] -> [H, W, 2], grey levels per pixel."""
    luma = frame.astype(np.float64) @ np.array(_LUMA)
    return np.stack([np.gradient(luma, axis=1), np.gradient(luma, axis=0)], axis=-1)


def window_mean(values: ArrayLike, side: int = WINDOW) -> Map:
    """Mean of [H, W] over the part of a side x side window that lies inside the image."""
    array = torch.as_tensor(np.asarray(values, dtype=np.float64))[None, None]
    pool = torch.nn.functional.avg_pool2d
    return pool(array, side, 1, side // 2, count_include_pad=False)[0, 0].numpy()


def local_contrast(frame: NDArray[np.uint8], side: int = WINDOW) -> Map:
    """Standard deviation of the luma in a window around each pixel, [H, W] in grey levels: 0 is flat."""
    luma = frame.astype(np.float64) @ np.array(_LUMA)
    return np.sqrt(np.maximum(window_mean(luma**2, side) - window_mean(luma, side) ** 2, 0.0))


def axis_contrast(frame: NDArray[np.uint8], side: int = WINDOW) -> Map:
    """Root mean square derivative in x and in y over a window, [H, W, 2] in grey levels per pixel.

    Where only one of the two is large (a straight edge), the motion along the other axis cannot be seen: the aperture
    problem.
    """
    gradient = image_gradient(frame)
    return np.stack([np.sqrt(window_mean(gradient[..., axis] ** 2, side)) for axis in (0, 1)], axis=-1)


def distance_to(mask: NDArray[np.bool_], limit: int = MAX_DISTANCE) -> Map:
    """Steps to the nearest true pixel, diagonal steps counting one: [H, W], 0 inside, at most `limit`."""
    reached = torch.from_numpy(np.ascontiguousarray(mask)).float()[None, None]
    distance = np.full(mask.shape, float(limit))
    distance[mask] = 0.0
    for step in range(1, limit):
        reached = torch.nn.functional.max_pool2d(reached, 3, 1, 1)
        distance = np.minimum(distance, np.where(reached[0, 0].numpy() > 0, step, limit))
    return distance


def boundary_regions(
    frame: NDArray[np.uint8], boundary: NDArray[np.bool_], occluded: NDArray[np.bool_] | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where motion jumps or is hidden, and plain, textured surfaces: bool [H, W] each.

    The first is within AT_PX of a motion boundary or occluded; the second has a local contrast of FLAT_GREY and more
    and is farther than AWAY_PX from both. BORDER_PX of the image are in neither.

    Args:
        frame: RGB uint8 [H, W, 3]. boundary, occluded: bool [H, W].
    """
    hidden = np.zeros_like(boundary) if occluded is None else occluded
    inside = np.zeros_like(boundary)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    distance = distance_to(boundary | hidden, AWAY_PX + 1)
    at = inside & ((distance_to(boundary, AT_PX + 1) <= AT_PX) | hidden)
    return at, inside & (distance > AWAY_PX) & (local_contrast(frame) >= FLAT_GREY)


def boundary_ratio(regions: tuple[NDArray[np.bool_], NDArray[np.bool_]], uncertainty: ArrayLike) -> float:
    """How much more uncertain a method is where motion jumps or is hidden than on plain, textured surfaces.

    The ratio of the medians over both regions (see :func:`boundary_regions`).

    Args:
        uncertainty: [H, W], any unit; NaN does not count.

    Returns:
        The ratio; NaN where either region has fewer than LEAST_PX pixels.
    """
    values = np.asarray(uncertainty)
    special, usual = (values[region & ~np.isnan(values)] for region in regions)
    if min(special.size, usual.size) < LEAST_PX:
        return float("nan")
    level = float(np.median(usual))
    return float(np.median(special)) / level if level > 0 else float("inf")


# --- the table -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PixelTable:
    """Sampled pixels of several pairs, M rows.

    Attributes:
        case: [M] int, which pair.
        deviation: [M, 2] flow minus true flow, pixels.
        expected: [M, 2] expected error, pixels.
        uncertainty: [M, 2] in the unit of the loss.
        motion: [M] length of the true flow, pixels.
        gradient: [M] length of the image gradient, grey levels per pixel.
        axis_contrast: [M, 2] see :func:`axis_contrast`.
        contrast: [M] see :func:`local_contrast`.
        boundary: [M] steps to the nearest depth boundary, at most MAX_DISTANCE; NaN without ground truth for it.
        occluded: [M] bool, hidden in frame 2.
    """

    case: NDArray[np.intp]
    deviation: Map
    expected: Map
    uncertainty: Map
    motion: Map
    gradient: Map
    axis_contrast: Map
    contrast: Map
    boundary: Map
    occluded: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.case)

    @property
    def error(self) -> Map:
        """[M] end-point error, pixels."""
        return np.hypot(self.deviation[:, 0], self.deviation[:, 1])

    @property
    def expected_norm(self) -> Map:
        """[M] 2-norm of the expected error over the axes, pixels."""
        return np.hypot(self.expected[:, 0], self.expected[:, 1])

    def where(self, rows: NDArray[np.bool_]) -> PixelTable:
        """The rows for which [M] is true."""
        return PixelTable(**{item.name: getattr(self, item.name)[rows] for item in fields(self)})

    def halves(self) -> tuple[PixelTable, PixelTable]:
        """Even and odd pairs apart: what is fitted on one half is held out from the other.

        Raises:
            ValueError: fewer than two pairs.
        """
        if len(np.unique(self.case)) < 2:
            raise ValueError("a held-out half needs at least 2 pairs.")
        return self.where(self.case % 2 == 0), self.where(self.case % 2 == 1)


def sample_pixels(answers: Iterable[Answer], per_pair: int = 20_000, seed: int = 0) -> PixelTable:
    """Keep `per_pair` random pixels with ground truth of every pair; `answers` may be a generator.

    Raises:
        ValueError: a pair without ground truth, or no pairs.
    """
    random = np.random.default_rng(seed)
    parts = []
    for number, (pair, field) in enumerate(answers):
        _, valid = _truth(pair)
        scored = np.flatnonzero(valid)
        rows = np.sort(random.choice(scored, size=min(per_pair, scored.size), replace=False))
        parts.append(_pixels(number, pair, field, rows))
    if not parts:
        raise ValueError("there are no pairs to analyse.")
    return PixelTable(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def sparsification(answers: Iterable[Answer], uncertainty: Callable[[FramePair, Any], ArrayLike]) -> viz.Curve:
    """Sparsification of the flow by any map, in the convention of `ajna.metrics.Sparsification` (per image, 50 bins).

    Args:
        uncertainty: (pair, field) -> [H, W], larger where the flow should be trusted less.

    Raises:
        ValueError: a pair without ground truth.
    """
    curves = Sparsification()
    for pair, field in answers:
        truth, valid = _truth(pair)
        flow, target = (torch.from_numpy(np.array(item)).permute(2, 0, 1)[None] for item in (field.flow, truth))
        scalar = torch.from_numpy(np.array(uncertainty(pair, field), dtype=np.float64))[None]
        curves.update(flow, target, scalar, torch.from_numpy(np.array(valid))[None])
    found = curves.compute()
    return viz.Curve(found.by_uncertainty.numpy(), found.oracle.numpy(), found.ause.item())


def _truth(pair: FramePair) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    if pair.flow is None or pair.valid is None:
        raise ValueError(f"case '{pair.name}' has no ground truth; an analysis of errors needs it.")
    return pair.flow, pair.valid


def _pixels(number: int, pair: FramePair, field: Any, rows: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    def pick(array: ArrayLike) -> NDArray[Any]:
        values = np.asarray(array)
        return values.reshape(-1, *values.shape[2:])[rows].astype(np.float64)

    truth, _ = _truth(pair)
    unknown = np.full(truth.shape[:2], np.nan)
    hidden = np.zeros(truth.shape[:2], dtype=np.bool_) if pair.occlusion is None else pair.occlusion
    return {
        "case": np.full(rows.size, number),
        "deviation": pick(field.flow) - pick(truth),
        "expected": pick(field.expected_error),
        "uncertainty": pick(field.uncertainty),
        "motion": pick(np.hypot(truth[..., 0], truth[..., 1])),
        "gradient": pick(np.linalg.norm(image_gradient(pair.frame1), axis=2)),
        "axis_contrast": pick(axis_contrast(pair.frame1)),
        "contrast": pick(local_contrast(pair.frame1)),
        "boundary": pick(unknown if pair.motion_boundary is None else distance_to(pair.motion_boundary)),
        "occluded": hidden.reshape(-1)[rows],
    }


# --- figures from it -----------------------------------------------------------------------------------------------


class Relation(NamedTuple):
    """Means over the pixels of each bin of a quantity; [K] each, empty bins left out."""

    value: Map  # mean of the quantity
    expected: Map  # mean expected error, pixels
    actual: Map  # mean actual error, pixels
    pixels: NDArray[np.intp]  # how many


def relation(quantity: ArrayLike, expected: ArrayLike, actual: ArrayLike, bins: int = 12) -> Relation:
    """Expected and actual error against a quantity, in bins that hold equally many pixels; rows with NaN are left out.

    A quantity that takes few values (a mask, steps) gets one bin for each.
    """
    x, e, a = (np.asarray(values, dtype=np.float64) for values in (quantity, expected, actual))
    known = np.isfinite(x)
    x, e, a = x[known], e[known], a[known]
    if x.size == 0:
        raise ValueError("the quantity is known in no pixel.")
    levels = np.unique(x)
    if levels.size <= 3 * bins:
        index = np.searchsorted(levels, x)
    else:
        inner = np.unique(np.quantile(x, np.linspace(0, 1, bins + 1)[1:-1]))
        index = np.searchsorted(inner, x, side="right")
    count = np.bincount(index)
    filled = count > 0
    value, mean_e, mean_a = (np.bincount(index, weights=values)[filled] / count[filled] for values in (x, e, a))
    return Relation(value, mean_e, mean_a, count[filled])


def reliability(expected: ArrayLike, actual: ArrayLike, bins: int = 15) -> Relation:
    """Observed against expected error: :func:`relation` with the expected error itself as the quantity.

    A network whose expected error is what it says has `actual` equal to `expected` in every bin.
    """
    return relation(expected, expected, actual, bins)


def calibration_error(curve: Relation) -> float:
    """Mean over the pixels of the distance of observed and expected error of their bin, pixels."""
    return float(np.average(np.abs(curve.actual - curve.expected), weights=curve.pixels))


class Correlations(NamedTuple):
    pearson: float
    spearman: float


def correlations(a: ArrayLike, b: ArrayLike) -> Correlations:
    """The paper's Eq. 9 (Pearson), and the same of the ranks (Spearman), over all rows pooled."""
    x, y = (torch.as_tensor(np.asarray(values, dtype=np.float64)) for values in (a, b))
    return Correlations(
        pearson_correlation(x, y).item(), pearson_correlation(average_ranks(x), average_ranks(y)).item()
    )


def axis_correlations(table: PixelTable) -> Map:
    """Rank correlations [2, 2] of the expected error of u, v (rows) with the absolute error of u, v (columns).

    A diagonal above its row and column means that each axis knows about its own error.
    """
    actual = np.abs(table.deviation)
    pairs = [[correlations(table.expected[:, i], actual[:, j]).spearman for j in (0, 1)] for i in (0, 1)]
    return np.array(pairs)


def aperture(table: PixelTable, bins: int = 12, min_contrast: float = 1.0) -> Relation:
    """log2 of (error of u / error of v), expected and actual, against log2 of (y / x derivative) around a pixel.

    To the right of 0 the texture varies mostly in y: v can be seen there and u cannot. Each bin's value is the ratio of
    the bin's mean errors. Only pixels with at least `min_contrast` grey levels per pixel in some direction count.
    """
    gx, gy = table.axis_contrast.T
    rows = np.hypot(gx, gy) >= min_contrast
    if not rows.any():
        raise ValueError(f"no pixel has a gradient of {min_contrast:g} grey levels per pixel.")
    texture = np.log2((gy[rows] + 1e-3) / (gx[rows] + 1e-3))
    actual = np.abs(table.deviation[rows])
    by_axis = [relation(texture, table.expected[rows, axis], actual[:, axis], bins) for axis in (0, 1)]
    u, v = by_axis
    return Relation(u.value, np.log2(u.expected / v.expected), np.log2(u.actual / v.actual), u.pixels)


class Intervals(NamedTuple):
    """Intervals flow +- factor * expected error, per axis; [L] per level."""

    level: Map  # share of the pixels that should lie inside
    factor: Map  # empirical quantile of |deviation| / expected error, from the fitting half
    coverage: Map  # [L, 2] share that does lie inside, u and v, on the other half
    width: Map  # [L] mean full width, pixels, on the other half


def intervals(
    fit: PixelTable, held_out: PixelTable, levels: Sequence[float] = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
) -> Intervals:
    """Prediction intervals from empirical quantiles, and whether they hold on pairs that gave none of the quantiles.

    The `level` quantile of |deviation| / expected error over both axes of `fit` is the number of expected errors that
    holds that share of the pixels. It is one number for all pixels: it promises the share over all, not in every place.

    Raises:
        ValueError: a level outside of (0, 1).
    """
    level = np.asarray(levels, dtype=np.float64)
    if not ((level > 0) & (level < 1)).all():
        raise ValueError(f"interval levels {list(levels)} must lie between 0 and 1, exclusive.")
    factor = np.quantile(np.abs(fit.deviation) / np.maximum(fit.expected, 1e-9), level)
    inside = np.abs(held_out.deviation)[None] <= factor[:, None, None] * held_out.expected[None]
    return Intervals(level, factor, inside.mean(axis=1), 2.0 * factor * held_out.expected.mean())


def coverage_by(table: PixelTable, quantity: ArrayLike, factor: float, bins: int = 10) -> tuple[Map, Map]:
    """Share of the pixels, both axes counted, inside flow +- factor * expected error, in bins of a quantity: [K] each.

    Returns the bins' mean quantity and the share: where it strays from the level, one factor is not enough.
    """
    inside = (np.abs(table.deviation) <= factor * table.expected).mean(axis=1)
    curve = relation(quantity, inside, inside, bins)
    return curve.value, curve.actual


def by_region(table: PixelTable, near: float = 3.0, flat: float = 2.0) -> dict[str, dict[str, float]]:
    """Mean expected and actual error (pixels) and share of the pixels: all, occluded, at depth boundaries, flat, rest.

    Args:
        near: steps to a depth boundary that count as at it.
        flat: grey levels of local contrast below which a pixel counts as flat.

    A pixel may be in several of the regions; "rest" is in none.
    """
    at_boundary, smooth = table.boundary <= near, table.contrast < flat
    regions = {
        "all": np.ones(len(table), dtype=np.bool_),
        "occluded": table.occluded,
        "at depth boundaries": at_boundary,
        "flat texture": smooth,
        "rest": ~(table.occluded | at_boundary | smooth),
    }
    error, expected = table.error, table.expected_norm
    return {
        name: {
            "share": float(rows.mean()),
            "expected": float(expected[rows].mean()) if rows.any() else float("nan"),
            "actual": float(error[rows].mean()) if rows.any() else float("nan"),
        }
        for name, rows in regions.items()
    }
