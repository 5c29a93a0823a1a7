# SPDX-License-Identifier: MIT
"""Scores of optical flow and of its uncertainty, as torchmetrics classes.

Every metric keeps only running sums (constant memory, summed over processes), takes batches of tensors and may be
mixed in a ``torchmetrics.MetricCollection`` that is fed by keyword::

    scores = MetricCollection([EndPointError(), AUSE(), Spearman(), OcclusionAUC()])
    scores.update(prediction=flow, target=truth, uncertainty=sigma, occlusion=hidden, valid=valid)

Shapes and units: ``prediction`` and ``target`` are [N, 2, H, W] in pixels; ``uncertainty`` is [N, 2, H, W] (its
2-norm over the axes is scored), [N, 1, H, W] or [N, H, W]; ``valid`` and ``occlusion`` are boolean [N, H, W] or
[N, 1, H, W]. Pixels whose target is not finite or beyond 1e9 in magnitude (Middlebury's "unknown") are never
scored; values in unscored pixels, NaN included, have no effect.

Averaging: every figure is the **mean over images of a per-image figure**, so that a dense and a sparse image count the
same. ``average="pixel"`` on the error metrics pools all pixels instead, as the KITTI benchmark does.

Degenerate cases, the same everywhere: an image without scored pixels does not count; without any counted image the
result is NaN; a NaN in a scored pixel of the prediction or the uncertainty makes the result NaN rather than hiding.
"""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

import torch
from torch import Tensor

try:
    from torchmetrics import Metric
except ModuleNotFoundError as error:
    raise ImportError(
        f"scores need the Python package torchmetrics ({error}): pip install torchmetrics", name="ajna.metrics"
    ) from error

UNKNOWN_FLOW = 1e9  # Middlebury: components beyond mean "no ground truth"

Average = Literal["image", "pixel"]


class SparsificationCurves(NamedTuple):
    """Curves averaged over images, each [bins + 1] float64, and the area between them."""

    removed: Tensor  # fraction of pixels removed, 0 to 1
    by_uncertainty: Tensor  # mean error of the kept pixels over the full mean, most uncertain pixels removed first
    oracle: Tensor  # the same, largest errors removed first
    ause: Tensor  # area between the two


# --- per-pixel and per-image functions -----------------------------------------------------------------------------


def end_point_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Euclidean distance of two flows: [..., 2, H, W] in pixels -> [..., H, W]."""
    return torch.linalg.vector_norm(prediction.double() - target.double(), dim=-3)


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


# --- metrics -------------------------------------------------------------------------------------------------------


class _RunningMean(Metric):
    """Sum and count, summed over processes. `name` keeps the states of different metrics apart (compute groups)."""

    is_differentiable = False
    full_state_update = False

    def __init__(self, name: str, average: str = "image", shape: tuple[int, ...] = ()) -> None:
        super().__init__()
        if average not in ("image", "pixel"):
            raise ValueError(f"average={average!r} is unknown; use 'image' (mean over images) or 'pixel' (all pixels).")
        self.average = average
        name = re.sub(r"\W", "_", f"{name}_{average}")
        self._names = (f"{name}_sum", f"{name}_count")
        self.add_state(self._names[0], torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state(self._names[1], torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def _add(self, total: Tensor, count: float = 1.0) -> None:
        for name, value in zip(self._names, (total, count), strict=True):
            state = getattr(self, name)
            setattr(self, name, state + torch.as_tensor(value, dtype=state.dtype, device=state.device))

    def _add_pixels(self, values: Tensor) -> None:
        """One image's scored pixels [M] of a figure that is a mean over pixels."""
        if self.average == "pixel":
            self._add(values.double().sum(), float(values.numel()))
        else:
            self._add(values.double().mean())

    def compute(self) -> Tensor:
        """The mean, scalar float64; NaN if nothing was counted."""
        total, count = (getattr(self, name) for name in self._names)
        return total / count  # 0 / 0 is NaN


def _check_map(name: str, value: Tensor, like: Tensor) -> Tensor:
    """[N, H, W] or [N, 1, H, W] -> [N, H, W], sizes equal to those of `like` [N, H, W]."""
    squeezed = value[:, 0] if value.dim() == 4 and value.shape[1] == 1 else value
    if squeezed.shape != like.shape:
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}, but the images are {tuple(like.shape)} (N, H, W); pass a map of "
            "that size, with or without a channel axis of 1."
        )
    return squeezed


def _scored(prediction: Tensor, target: Tensor, valid: Tensor | None) -> Tensor:
    """Mask [N, H, W] of the pixels that have ground truth and are wanted."""
    if prediction.dim() != 4 or prediction.shape[1] != 2 or prediction.shape != target.shape:
        raise ValueError(
            f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)} must both be [N, 2, H, W]."
        )
    known = (target.abs() <= UNKNOWN_FLOW).all(dim=1)  # false for NaN and Inf, too
    return known if valid is None else known & _check_map("valid", valid, known).bool()


class _ErrorMetric(_RunningMean):
    """A mean over pixels of a function of prediction and target."""

    higher_is_better = False

    def update(self, prediction: Tensor, target: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target [N, 2, H, W] px; valid bool [N, H, W] or [N, 1, H, W]."""
        mask = _scored(prediction, target, valid)
        values = self._pixel_values(end_point_error(prediction, target), target)
        for image_values, image_mask in zip(values, mask, strict=True):
            if image_mask.any():
                self._add_pixels(image_values[image_mask])

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        raise NotImplementedError


def _flag(outlier: Tensor, error: Tensor) -> Tensor:
    # A comparison with NaN is false: without this a NaN prediction would pass as an inlier.
    return torch.where(error.isnan(), error, outlier.double())


class EndPointError(_ErrorMetric):
    """Mean end-point error in pixels: mean over each image's scored pixels, averaged over images."""

    def __init__(self, average: Average = "image") -> None:
        super().__init__("epe", average)

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        return error


class FlAll(_ErrorMetric):
    """KITTI's outliers: fraction (0 to 1) of pixels whose error is over 3 px *and* over 5 % of the true magnitude.

    Per image, averaged over images; KITTI's own table pools pixels: ``average="pixel"``.
    """

    def __init__(self, average: Average = "image") -> None:
        super().__init__("fl_all", average)

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        magnitude = torch.linalg.vector_norm(target.double(), dim=1)
        return _flag((error > 3.0) & (error > 0.05 * magnitude), error)


class OutlierRate(_ErrorMetric):
    """Fraction (0 to 1) of pixels whose end-point error is over `threshold_px`; per image, averaged over images."""

    def __init__(self, threshold_px: float = 3.0, average: Average = "image") -> None:
        if not threshold_px >= 0:
            raise ValueError(f"threshold_px={threshold_px} must not be negative; usual values are 1, 3 and 5.")
        super().__init__(f"outlier_{threshold_px:g}px", average)
        self.threshold_px = float(threshold_px)

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        return _flag(error > self.threshold_px, error)


class _UncertaintyMetric(_RunningMean):
    """A figure per image of (uncertainty norm, end-point error) over the scored pixels."""

    def update(self, prediction: Tensor, target: Tensor, uncertainty: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target [N, 2, H, W] px; uncertainty [N, 2 or 1, H, W] or [N, H, W]; valid bool."""
        mask = _scored(prediction, target, valid)
        norm = _check_map("uncertainty", uncertainty_norm(uncertainty), mask)
        error = end_point_error(prediction, target)
        for image_norm, image_error, image_mask in zip(norm, error, mask, strict=True):
            if image_mask.any():
                self._add_image(image_norm[image_mask], image_error[image_mask])

    def _add_image(self, uncertainty: Tensor, error: Tensor) -> None:
        raise NotImplementedError


class _Correlation(_UncertaintyMetric):
    higher_is_better = True

    def _add_image(self, uncertainty: Tensor, error: Tensor) -> None:
        if uncertainty.isnan().any() or error.isnan().any():
            self._add(uncertainty.new_full((), torch.nan))
        elif error.min() != error.max():  # the same error everywhere: undefined, not counted
            self._add(self._correlation(uncertainty, error))

    def _correlation(self, uncertainty: Tensor, error: Tensor) -> Tensor:
        raise NotImplementedError


class Spearman(_Correlation):
    """Rank correlation (-1 to 1) of uncertainty norm and end-point error, ties averaged; per image, then averaged.

    A constant uncertainty tells nothing and counts 0; an image with the same error everywhere is not counted.
    """

    def __init__(self) -> None:
        super().__init__("spearman")

    def _correlation(self, uncertainty: Tensor, error: Tensor) -> Tensor:
        return pearson_correlation(average_ranks(uncertainty), average_ranks(error))


class Pearson(_Correlation):
    """Linear correlation (-1 to 1) of uncertainty norm and end-point error; per image, then averaged.

    Degenerate images as in :class:`Spearman`.
    """

    def __init__(self) -> None:
        super().__init__("pearson")

    def _correlation(self, uncertainty: Tensor, error: Tensor) -> Tensor:
        return pearson_correlation(uncertainty, error)


class Sparsification(_UncertaintyMetric):
    """Sparsification curves per image, averaged over images, and AUSE; compute() gives SparsificationCurves.

    The convention (others differ by about a factor of two): mean EPE of the kept pixels divided by the mean EPE of
    all, 50 bins, per image; AUSE is the area between the curve by uncertainty and the oracle's. A constant
    uncertainty gives a flat curve at 1 (ties count in expectation); an image without any error has AUSE 0.
    """

    higher_is_better = False

    def __init__(self, bins: int = 50) -> None:
        if bins < 2:
            raise ValueError(f"bins={bins} is too few for a curve; use at least 2 (the convention is 50).")
        super().__init__(f"sparsification_{bins}", shape=(2, bins + 1))
        self.bins = bins

    def _add_image(self, uncertainty: Tensor, error: Tensor) -> None:
        if uncertainty.isnan().any():
            self._add(uncertainty.new_full((2, self.bins + 1), torch.nan))
        else:
            self._add(torch.stack(sparsification_curves(uncertainty, error, self.bins)))

    def compute(self) -> SparsificationCurves:  # type: ignore[override]
        """Mean curves over the images counted; all NaN if there were none."""
        by_uncertainty, oracle = super().compute()
        removed = torch.linspace(0, 1, self.bins + 1, dtype=torch.float64, device=oracle.device)
        return SparsificationCurves(removed, by_uncertainty, oracle, area_between(by_uncertainty, oracle))


class AUSE(Sparsification):
    """Area under the sparsification error alone, a scalar (0 is best); see :class:`Sparsification`."""

    def compute(self) -> Tensor:  # type: ignore[override]
        """Mean over images, scalar float64; NaN if there were none."""
        return super().compute().ause


class OcclusionAUC(_RunningMean):
    """Area under the ROC curve of the uncertainty norm as a detector of a mask; exact with ties; per image, averaged.

    0.5 is chance (and what a constant uncertainty gets). Images whose mask is all true or all false are not counted.
    """

    higher_is_better = True

    def __init__(self) -> None:
        super().__init__("occlusion_auc")

    def update(self, uncertainty: Tensor, occlusion: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: uncertainty [N, 2 or 1, H, W] or [N, H, W]; occlusion, valid bool [N, H, W] or [N, 1, H, W]."""
        norm = uncertainty_norm(uncertainty)
        positive = _check_map("occlusion", occlusion, norm).bool()
        mask = torch.ones_like(positive) if valid is None else _check_map("valid", valid, norm).bool()
        for image_norm, image_positive, image_mask in zip(norm, positive, mask, strict=True):
            score, hidden = image_norm[image_mask], image_positive[image_mask]
            if hidden.any() and not hidden.all():
                self._add(score.new_full((), torch.nan) if score.isnan().any() else roc_auc(score, hidden))
