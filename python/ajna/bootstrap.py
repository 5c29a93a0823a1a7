# SPDX-License-Identifier: MIT
"""Confidence intervals of independent trials."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["bootstrap_interval"]

_RESAMPLES = 2000
Floats = NDArray[np.float64]


def bootstrap_interval(
    values: ArrayLike,
    level: float = 0.95,
    statistic: Callable[[Floats], Floats] = lambda samples: samples.mean(axis=-1),
    resamples: int = _RESAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic (by default the mean) of independent trials.

    Where all values are equal it has no width; the number of trials stands beside it in every table for that reason.

    Args:
        values: one number per trial [N].
        statistic: from [..., N] to [...].

    Raises:
        ValueError: for no values, or a level outside (0, 1).
    """
    sample = np.asarray(values, dtype=np.float64).ravel()
    if sample.size == 0:
        raise ValueError("a confidence interval needs at least one trial")
    if not 0 < level < 1:
        raise ValueError(f"confidence level {level} is outside (0, 1): give for example 0.95")
    random = np.random.default_rng(seed)
    drawn = statistic(sample[random.integers(0, sample.size, (resamples, sample.size))])
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
