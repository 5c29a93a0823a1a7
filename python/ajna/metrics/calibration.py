# SPDX-License-Identifier: MIT
"""Metrics of what uncertainty says in pixels: reliability of the expected error, coverage and width of intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ajna.metrics.base import Average, RunningMean, check_map, scored_pixels

_TWENTIETHS = tuple(k / 20 for k in range(1, 20))


class ReliabilityCurve(NamedTuple):
    """Expected against observed error per bin of the expected error; float64, NaN in bins without pixels."""

    edges: Tensor  # [B + 1] px, from 0 to infinity
    weight: Tensor  # [B], share of the bin; sums to 1
    expected: Tensor  # [B] px, mean expected error
    observed: Tensor  # [B] px, mean absolute error
    ece: Tensor  # weighted mean of |observed - expected|, px
    ence: Tensor  # weighted mean of |observed - expected| / expected


class CoverageCurve(NamedTuple):
    """How much the intervals of several levels hold; float64 [L] each (scalars for one level), `error` a scalar."""

    levels: Tensor  # share promised
    coverage: Tensor  # share of flow components inside
    width: Tensor  # mean width, px
    error: Tensor  # mean of |coverage - level| over the levels


class QuantileCurve(NamedTuple):
    """Promised against observed quantiles; float64 [L] each (scalars for one level), `error` a scalar."""

    levels: Tensor
    observed: Tensor  # share of values whose cdf is at most the level
    error: Tensor  # mean of |observed - level| over the levels


def _axes(name: str, value: Tensor, like: Tensor) -> Tensor:
    """float64 [N, 2, H, W]."""
    if value.shape != like.shape:
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}, but the flow has {tuple(like.shape)}; pass its shape."
        )
    return value.double()


def _shares(levels: Sequence[float]) -> Tensor:
    if not levels or not all(0 < low < high < 1 for low, high in zip((0.5 * levels[0], *levels), levels, strict=False)):
        raise ValueError(f"levels={list(levels)} are not usable; give strictly rising shares inside (0, 1).")
    return torch.tensor(levels, dtype=torch.float64)


class _PerAxis(RunningMean):
    """A figure of the components [2, M] of one image's scored pixels."""

    def _components(self, mask: Tensor, *maps: Tensor) -> list[list[Tensor]]:
        """Per image with scored pixels, its part of each map as [2, M]."""
        return [
            [image[:, chosen] for image in images] for chosen, *images in zip(mask, *maps, strict=True) if chosen.any()
        ]

    def _add_mean(self, total: Tensor, pixels: int) -> None:
        """`total` over one image's scored pixels."""
        if self.average == "pixel":
            self._add(total, float(pixels))
        else:
            self._add(total / pixels)


class Reliability(_PerAxis):
    """Reliability diagram of a regression: expected against observed absolute error per axis; compute() gives a curve.

    Components of the flow are sorted by their expected error into bins of equal ratio between `low_px` and `high_px`,
    with an open bin at either end. The curve of a calibrated model lies on the diagonal. `ece` weighs the distances
    from it by the share of each bin; `ence` takes them relative to the expected error (as Levi et al., 2022, but in
    mean absolute errors and fixed bins).

    Args:
        bins: bins between the ends.
        low_px, high_px: where the open bins begin.
        average: ``"image"``: each image has the same weight; ``"pixel"``: each pixel.
    """

    higher_is_better = False

    _inner_edges: Tensor

    def __init__(
        self, bins: int = 32, low_px: float = 0.01, high_px: float = 100.0, average: Average = "image"
    ) -> None:
        if bins < 1 or not 0 < low_px < high_px < math.inf:
            raise ValueError(
                f"bins={bins} from {low_px} to {high_px} px are not usable; give at least 1 and 0 < low_px < high_px."
            )
        super().__init__(f"reliability_{bins}_{low_px:g}_{high_px:g}", average, (3, bins + 2))
        inner = torch.logspace(math.log10(low_px), math.log10(high_px), bins + 1, dtype=torch.float64)
        self.register_buffer("_inner_edges", inner, persistent=False)

    def update(self, prediction: Tensor, target: Tensor, expected_error: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target, expected_error [N, 2, H, W] px; valid bool [N, H, W] or [N, 1, H, W]."""
        mask = scored_pixels(prediction, target, valid)
        expected = _axes("expected_error", expected_error, prediction)
        observed = (target.double() - prediction.double()).abs()
        edges = self._inner_edges
        for expectation, error in self._components(mask, expected, observed):
            sums = torch.stack([torch.ones_like(error), expectation, error]).flatten(1)  # [3, 2 M]
            if sums.isnan().any():
                self._add(sums.new_full((3, edges.numel() + 1), torch.nan))
                continue
            bins = torch.bucketize(expectation.flatten(), edges)
            total = sums.new_zeros(3, edges.numel() + 1).index_add_(1, bins, sums)
            self._add_mean(total / 2, error.shape[1])  # two components per pixel

    def compute(self) -> ReliabilityCurve:  # type: ignore[override]
        """The curve over all images counted; all NaN if there were none."""
        weight, expected, observed = super().compute()
        inner = self._inner_edges
        edges = torch.cat([inner.new_zeros(1), inner, inner.new_full((1,), torch.inf)])
        gap = (observed - expected).abs()
        relative = torch.where(gap == 0, 0.0, gap * weight / expected)  # 0 expected, 0 observed: no gap
        return ReliabilityCurve(edges, weight, expected / weight, observed / weight, gap.sum(), relative.sum())


class ExpectedCalibrationError(Reliability):
    """The ECE of :class:`Reliability` alone, a scalar in pixels (0 is best)."""

    def compute(self) -> Tensor:  # type: ignore[override]
        """Weighted mean gap, scalar float64; NaN if there were no images."""
        return super().compute().ece


class Coverage(_PerAxis):
    """Coverage and sharpness of intervals flow -+ factor * expected_error at several levels; compute() gives the curve.

    Args:
        levels: shares promised, rising inside (0, 1).
        factors: (u, v) per level, as ``ConformalFactors`` holds them.
        average: over images or pixels.
    """

    higher_is_better = None

    _levels: Tensor
    _factors: Tensor

    def __init__(self, levels: Sequence[float], factors: Sequence[Sequence[float]], average: Average = "image") -> None:
        shares = _shares(levels)
        if len(factors) != len(levels) or any(len(pair) != 2 for pair in factors):
            raise ValueError(f"{len(factors)} factors for {len(levels)} levels: give one pair (u, v) per level.")
        name = "coverage_" + "_".join(f"{value:g}" for pair in factors for value in pair)
        super().__init__(name, average, (2, len(levels)))
        self.register_buffer("_levels", shares, persistent=False)
        self.register_buffer("_factors", torch.tensor(factors, dtype=torch.float64), persistent=False)

    def update(self, prediction: Tensor, target: Tensor, expected_error: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: as :meth:`Reliability.update`."""
        mask = scored_pixels(prediction, target, valid)
        expected = _axes("expected_error", expected_error, prediction)
        observed = (target.double() - prediction.double()).abs()
        for expectation, error in self._components(mask, expected, observed):
            if expectation.isnan().any() or error.isnan().any():
                self._add(error.new_full((2, self._levels.numel()), torch.nan))
                continue
            reach = self._factors.T[:, :, None] * expectation[:, None]  # [2, L, M]
            inside = (error[:, None] <= reach).double().mean(dim=0).sum(dim=1)
            self._add_mean(torch.stack([inside, 2 * reach.mean(dim=0).sum(dim=1)]), error.shape[1])

    def compute(self) -> CoverageCurve:  # type: ignore[override]
        """The curve over all images counted; NaN if there were none."""
        coverage, width = super().compute()
        return CoverageCurve(self._levels, coverage, width, (coverage - self._levels).abs().mean())


class IntervalCoverage(_PerAxis):
    """Share (0 to 1) of the flow's components that lie inside [low, high], ends included; per image, averaged."""

    higher_is_better = None

    def __init__(self, average: Average = "image") -> None:
        super().__init__("interval_coverage", average)

    def update(self, target: Tensor, low: Tensor, high: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: target, low, high [N, 2, H, W] px; valid bool [N, H, W] or [N, 1, H, W]."""
        mask = scored_pixels(target, target, valid)
        for truth, below, above in self._components(
            mask, target.double(), _axes("low", low, target), _axes("high", high, target)
        ):
            # A comparison with NaN is false: NaN ends must not pass as a miss.
            unknown = below.isnan() | above.isnan()
            inside = torch.where(unknown, torch.nan, ((below <= truth) & (truth <= above)).double())
            self._add_mean(inside.mean(dim=0).sum(), truth.shape[1])


class IntervalWidth(_PerAxis):
    """Sharpness: mean width high - low over pixels and axes, px; per image, averaged.

    Of two models with the same coverage the one with the narrower intervals is better.
    """

    higher_is_better = False

    def __init__(self, average: Average = "image") -> None:
        super().__init__("interval_width", average)

    def update(self, target: Tensor, low: Tensor, high: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: as :meth:`IntervalCoverage.update`; the target only says which pixels are scored."""
        mask = scored_pixels(target, target, valid)
        width = _axes("high", high, target) - _axes("low", low, target)
        for (image,) in self._components(mask, width):
            self._add_mean(image.mean(dim=0).sum(), image.shape[1])


class QuantileCalibration(RunningMean):
    """Quantile-coverage form of calibration (Kuleshov et al., 2018), for losses that are likelihoods.

    Fed with the predicted cdf at the true value, ``loss.cdf(target - prediction, raw)``, which is uniform for a
    calibrated density; compute() gives the share of values at most each level.

    Args:
        levels: rising inside (0, 1); by default 0.05 to 0.95 in steps of 0.05.
    """

    higher_is_better = False

    _levels: Tensor

    def __init__(self, levels: Sequence[float] = _TWENTIETHS) -> None:
        shares = _shares(levels)
        super().__init__("quantile_" + "_".join(f"{level:g}" for level in levels), shape=(len(levels),))
        self.register_buffer("_levels", shares, persistent=False)

    def update(self, cdf: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: cdf [N, C, H, W] in 0 to 1; valid bool [N, H, W] or [N, 1, H, W]."""
        if cdf.dim() != 4:
            raise ValueError(f"cdf has shape {tuple(cdf.shape)}; pass [N, C, H, W].")
        mask = torch.ones_like(cdf[:, 0], dtype=torch.bool)
        mask = mask if valid is None else check_map("valid", valid, mask).bool()
        for image, chosen in zip(cdf.double(), mask, strict=True):
            if not chosen.any():
                continue
            values = image[:, chosen].flatten()
            if values.isnan().any():
                self._add(values.new_full(self._levels.shape, torch.nan))
            else:
                place = torch.bucketize(values, self._levels)  # levels below the value
                at_most = torch.bincount(place, minlength=self._levels.numel() + 1).cumsum(0)
                self._add(at_most[:-1].double() / values.numel())

    def compute(self) -> QuantileCurve:  # type: ignore[override]
        """The curve over all images counted; NaN if there were none."""
        observed = super().compute()
        return QuantileCurve(self._levels, observed, (observed - self._levels).abs().mean())
