# SPDX-License-Identifier: MIT
"""How much larger a figure is in one region than in another, over the pixels of many images together.

The ratio of an image's own medians (`ajna.analysis.boundary_ratio`) says nothing of images in which one of the regions
is small, and its mean is that of the few images where it is large. Here all pixels of a region count alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["PooledRatio"]

_LOWEST, _HIGHEST = 1e-4, 1e4  # of the figure: what lies outside counts as these
_STEP = 0.02  # width of a bin, relative to its place
_EDGES = np.exp(np.arange(np.log(_LOWEST), np.log(_HIGHEST) + _STEP, _STEP))
_RESAMPLES = 1000

Counts = NDArray[np.uint32]


class PooledRatio:
    """The median over the pixels of a special region of all images, over that of a usual one; to within 2 %."""

    def __init__(self) -> None:
        self._images: list[Counts] = []  # [2, bins] each

    def add(self, special: ArrayLike, usual: ArrayLike) -> None:
        """The values of one image in both regions: 1-D, not negative, any number; NaN does not count."""
        self._images.append(np.stack([_counted(special), _counted(usual)]))

    def join(self, other: PooledRatio) -> None:
        """Count the other's images, too."""
        self._images.extend(other._images)

    @property
    def ratio(self) -> float | None:
        """None where a region has no pixel in any image."""
        return _ratio(np.stack(self._images).sum(axis=0, dtype=np.float64)) if self._images else None

    def interval(self, level: float = 0.95, seed: int = 0) -> tuple[float, float] | None:
        """Percentile bootstrap interval over the images; None for fewer than two, or where the ratio is not defined."""
        if len(self._images) < 2 or self.ratio is None:
            return None
        images = np.stack(self._images).astype(np.float64)
        random = np.random.default_rng(seed)
        times = random.multinomial(len(images), [1 / len(images)] * len(images), _RESAMPLES)
        drawn = [_ratio(np.tensordot(one, images, axes=1)) for one in times.astype(np.float64)]
        low, high = np.quantile([one for one in drawn if one is not None], [(1 - level) / 2, (1 + level) / 2])
        return float(low), float(high)


def _counted(values: ArrayLike) -> Counts:
    flat = np.asarray(values, dtype=np.float64).ravel()
    bounded = np.clip(flat[~np.isnan(flat)], _EDGES[0], _EDGES[-1])
    return np.histogram(bounded, bins=_EDGES)[0].astype(np.uint32)


def _ratio(counts: NDArray[np.float64]) -> float | None:
    if not counts.sum(axis=1).all():
        return None
    special, usual = (_median(row) for row in counts)
    return special / usual


def _median(counts: NDArray[np.float64]) -> float:
    """Of a histogram over _EDGES, linear within a bin."""
    below = np.cumsum(counts)
    half = below[-1] / 2
    place = int(np.searchsorted(below, half))
    inside = (half - (below[place] - counts[place])) / counts[place]
    return float(_EDGES[place] + inside * (_EDGES[place + 1] - _EDGES[place]))
