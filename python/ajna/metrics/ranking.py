# SPDX-License-Identifier: MIT
"""Metrics of how well uncertainty tells good pixels from bad ones, whatever its unit."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ajna.metrics.base import RunningMean, check_map, scored_pixels
from ajna.metrics.functions import (
    area_between,
    average_ranks,
    end_point_error,
    kitti_outliers,
    pearson_correlation,
    roc_auc,
    sparsification_curves,
    uncertainty_norm,
)


class SparsificationCurves(NamedTuple):
    """Curves averaged over images, each [bins + 1] float64, and the area between them."""

    removed: Tensor  # fraction of pixels removed, 0 to 1
    by_uncertainty: Tensor  # mean error of the kept pixels over the full mean, most uncertain pixels removed first
    oracle: Tensor  # the same, largest errors removed first
    ause: Tensor  # area between the two


class _UncertaintyMetric(RunningMean):
    """A figure per image of (uncertainty norm, end-point error) over the scored pixels."""

    def update(self, prediction: Tensor, target: Tensor, uncertainty: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target [N, 2, H, W] px; uncertainty [N, 2 or 1, H, W] or [N, H, W]; valid bool."""
        mask = scored_pixels(prediction, target, valid)
        norm = check_map("uncertainty", uncertainty_norm(uncertainty), mask)
        error = self._pixel_error(end_point_error(prediction, target), target)
        for image_norm, image_error, image_mask in zip(norm, error, mask, strict=True):
            if image_mask.any():
                self._add_image(image_norm[image_mask], image_error[image_mask])

    def _pixel_error(self, error: Tensor, target: Tensor) -> Tensor:
        return error

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
    """Linear correlation (-1 to 1) of uncertainty norm and end-point error (paper Eq. 9); per image, then averaged.

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

    Args:
        bins: steps of the curve.
        of: the error that is left, ``"epe"``, or ``"fl"`` for the share of KITTI's outliers (see FlAll).
    """

    higher_is_better = False

    def __init__(self, bins: int = 50, of: Literal["epe", "fl"] = "epe") -> None:
        if bins < 2:
            raise ValueError(f"bins={bins} is too few for a curve; use at least 2 (the convention is 50).")
        if of not in ("epe", "fl"):
            raise ValueError(f"of={of!r} is unknown; use 'epe' (end-point error) or 'fl' (KITTI's outliers).")
        super().__init__(f"sparsification_{of}_{bins}", shape=(2, bins + 1))
        self.bins, self.of = bins, of

    def _pixel_error(self, error: Tensor, target: Tensor) -> Tensor:
        return kitti_outliers(error, target) if self.of == "fl" else error

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


class _MaskAUC(RunningMean):
    """Area under the ROC curve of the uncertainty norm as a detector of a mask."""

    higher_is_better = True

    def _add_batch(self, uncertainty: Tensor, name: str, mask: Tensor, valid: Tensor | None) -> None:
        norm = uncertainty_norm(uncertainty)
        positive = check_map(name, mask, norm).bool()
        counted = torch.ones_like(positive) if valid is None else check_map("valid", valid, norm).bool()
        for image_norm, image_positive, image_counted in zip(norm, positive, counted, strict=True):
            score, chosen = image_norm[image_counted], image_positive[image_counted]
            if chosen.any() and not chosen.all():
                self._add(score.new_full((), torch.nan) if score.isnan().any() else roc_auc(score, chosen))


class OcclusionAUC(_MaskAUC):
    """Area under the ROC curve of the uncertainty norm as a detector of a mask; exact with ties; per image, averaged.

    0.5 is chance (and what a constant uncertainty gets). Images whose mask is all true or all false are not counted.
    """

    def __init__(self) -> None:
        super().__init__("occlusion_auc")

    def update(self, uncertainty: Tensor, occlusion: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: uncertainty [N, 2 or 1, H, W] or [N, H, W]; occlusion, valid bool [N, H, W] or [N, 1, H, W]."""
        self._add_batch(uncertainty, "occlusion", occlusion, valid)


class MotionBoundaryAUC(_MaskAUC):
    """The same for motion boundaries (given by the data set, or by :func:`motion_boundaries`)."""

    def __init__(self) -> None:
        super().__init__("motion_boundary_auc")

    def update(self, uncertainty: Tensor, motion_boundary: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: as :meth:`OcclusionAUC.update`, with motion_boundary in the place of occlusion."""
        self._add_batch(uncertainty, "motion_boundary", motion_boundary, valid)
