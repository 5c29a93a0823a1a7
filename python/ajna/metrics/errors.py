# SPDX-License-Identifier: MIT
"""Metrics of the flow itself."""

from __future__ import annotations

from torch import Tensor

from ajna.metrics.base import Average, RunningMean, scored_pixels
from ajna.metrics.functions import end_point_error, kitti_outliers, outlier_flags


class _ErrorMetric(RunningMean):
    """A mean over pixels of a function of prediction and target."""

    higher_is_better = False

    def update(self, prediction: Tensor, target: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target [N, 2, H, W] px; valid bool [N, H, W] or [N, 1, H, W]."""
        mask = scored_pixels(prediction, target, valid)
        values = self._pixel_values(end_point_error(prediction, target), target)
        for image_values, image_mask in zip(values, mask, strict=True):
            if image_mask.any():
                self._add_pixels(image_values[image_mask])

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        raise NotImplementedError


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
        return kitti_outliers(error, target)


class OutlierRate(_ErrorMetric):
    """Fraction (0 to 1) of pixels whose end-point error is over `threshold_px`; per image, averaged over images."""

    def __init__(self, threshold_px: float = 3.0, average: Average = "image") -> None:
        if not threshold_px >= 0:
            raise ValueError(f"threshold_px={threshold_px} must not be negative; usual values are 1, 3 and 5.")
        super().__init__(f"outlier_{threshold_px:g}px", average)
        self.threshold_px = float(threshold_px)

    def _pixel_values(self, error: Tensor, target: Tensor) -> Tensor:
        return outlier_flags(error > self.threshold_px, error)
