# SPDX-License-Identifier: MIT
"""Per-pixel and per-image figures as functions on tensors; the metrics average them."""

from __future__ import annotations

import torch
from torch import Tensor

UNKNOWN_FLOW = 1e9  # Middlebury: components beyond mean "no ground truth"


def end_point_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Euclidean distance of two flows: [..., 2, H, W] in pixels -> [..., H, W]."""
    return torch.linalg.vector_norm(prediction.double() - target.double(), dim=-3)


def outlier_flags(outlier: Tensor, error: Tensor) -> Tensor:
    """Booleans as 0.0 and 1.0, NaN where `error` is NaN; both of one shape."""
    # A comparison with NaN is false: without this a NaN prediction would pass as an inlier.
    return torch.where(error.isnan(), error, outlier.double())


def kitti_outliers(error: Tensor, target: Tensor) -> Tensor:
    """KITTI's outliers: 1.0 where `error` [N, H, W] is over 3 px and 5 % of the length of `target` [N, 2, H, W]."""
    magnitude = torch.linalg.vector_norm(target.double(), dim=1)
    return outlier_flags((error > 3.0) & (error > 0.05 * magnitude), error)


def motion_boundaries(flow: Tensor, valid: Tensor | None = None, min_jump_px: float = 1.0) -> Tensor:
    """Where the true motion jumps: pixels with a direct neighbour whose motion differs by more than `min_jump_px`.

    For data sets with dense ground truth that do not mark motion boundaries themselves.

    Args:
        flow: [N, 2, H, W], pixels.
        valid: bool [N, H, W]; a pixel without known motion is no boundary and makes none.
        min_jump_px: length of the difference, pixels.

    Returns:
        bool [N, H, W].
    """
    known = (flow.abs() <= UNKNOWN_FLOW).all(dim=1)
    known = known if valid is None else known & valid
    boundary = torch.zeros_like(known)
    for axis in (1, 2):  # of [N, H, W]
        size = known.shape[axis]
        first, second = (flow.narrow(axis + 1, start, size - 1) for start in (0, 1))
        both = known.narrow(axis, 0, size - 1) & known.narrow(axis, 1, size - 1)
        jump = both & (torch.linalg.vector_norm(second - first, dim=1) > min_jump_px)
        for start in (0, 1):
            boundary.narrow(axis, start, size - 1).logical_or_(jump)
    return boundary


def uncertainty_norm(uncertainty: Tensor) -> Tensor:
    """The scalar map that is scored: 2-norm over the axes, [N, 2, H, W], [N, 1, H, W] or [N, H, W] -> [N, H, W]."""
    if uncertainty.dim() == 3:
        return uncertainty.double()
    if uncertainty.dim() != 4 or uncertainty.shape[1] not in (1, 2):
        raise ValueError(
            f"uncertainty has shape {tuple(uncertainty.shape)}; pass [N, 2, H, W], [N, 1, H, W] or [N, H, W]."
        )
    if uncertainty.shape[1] == 1:
        return uncertainty[:, 0].double()
    return torch.linalg.vector_norm(uncertainty.double(), dim=1)


def average_ranks(values: Tensor) -> Tensor:
    """Ranks 1..M of a vector [M], ties sharing their mean rank; float64."""
    _, inverse, counts = torch.unique(values, return_inverse=True, return_counts=True)
    last = counts.cumsum(0).double()
    return (last - (counts.double() - 1.0) / 2.0)[inverse]


def pearson_correlation(a: Tensor, b: Tensor) -> Tensor:
    """Linear correlation of two vectors [M]; 0 if `a` is constant, NaN (undefined) if `b` is."""
    a, b = a.double(), b.double()
    # Constancy is asked of the values themselves: centring a constant may leave rounding noise, not zero.
    if b.numel() < 2 or b.min() == b.max():
        return b.new_full((), torch.nan)
    if a.min() == a.max():
        return a.new_zeros(())
    a, b = a - a.mean(), b - b.mean()
    return (a / torch.linalg.vector_norm(a) * (b / torch.linalg.vector_norm(b))).sum().clamp(-1.0, 1.0)


def roc_auc(score: Tensor, positive: Tensor) -> Tensor:
    """Probability that a positive scores above a negative, ties counting one half; NaN if a class is empty.

    Exact, from the rank sum (Mann-Whitney). `score` [M] real, `positive` [M] bool.
    """
    positives = positive.sum().double()
    negatives = positive.numel() - positives
    rank_sum = average_ranks(score)[positive].sum()
    return (rank_sum - positives * (positives + 1.0) / 2.0) / (positives * negatives)


def sparsification_curves(uncertainty: Tensor, error: Tensor, bins: int = 50) -> tuple[Tensor, Tensor]:
    """Mean error of the pixels kept, over the full mean, as the most uncertain are removed in `bins` equal steps.

    Args:
        uncertainty: [M] real, M > 0. Pixels of equal uncertainty are removed in random order *in expectation*: each
            counts with the mean error of its group, so that the result does not depend on how a sort breaks ties.
        error: [M] real, not negative.
        bins: number of steps; step k keeps M - floor(k M / bins) pixels.

    Returns:
        (by_uncertainty, oracle): float64 [bins + 1]; the last value, with no pixel left, is 0 by convention. Without
        any error both are 1 up to the last value: no order can be better than another.
    """
    error = error.double()
    count = error.numel()
    mean = error.mean()
    steps = torch.arange(bins, device=error.device)
    kept = count - (count * steps) // bins

    def curve(key: Tensor) -> Tensor:
        order = torch.argsort(key, stable=True)
        _, group, sizes = torch.unique_consecutive(key[order], return_inverse=True, return_counts=True)
        group_mean = torch.zeros(sizes.numel(), dtype=torch.float64, device=error.device)
        group_mean = group_mean.index_add(0, group, error[order]) / sizes
        kept_mean = group_mean[group].cumsum(0)[kept - 1] / kept
        relative = torch.ones_like(kept_mean) if mean == 0 else kept_mean / mean
        return torch.cat([relative, relative.new_zeros(1)])

    return curve(uncertainty), curve(error)


def area_between(by_uncertainty: Tensor, oracle: Tensor) -> Tensor:
    """AUSE: trapezoidal area between two sparsification curves [bins + 1] over the fraction removed, 0 to 1."""
    gap = by_uncertainty - oracle
    return torch.trapezoid(gap, dx=1.0 / (gap.numel() - 1))
