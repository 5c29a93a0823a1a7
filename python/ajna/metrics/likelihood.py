# SPDX-License-Identifier: MIT
"""Proper scores of the predicted density, for losses that are likelihoods."""

from __future__ import annotations

import torch
from torch import Tensor

from ajna.losses import UncertaintyLoss
from ajna.metrics.base import RunningMean, check_map
from ajna.metrics.functions import UNKNOWN_FLOW

_JOINT = ("l2", "squared_l2")  # terms over the channel axis: one density over all channels


class _DensityMetric(RunningMean):
    """A mean over pixels of a figure of the loss's likelihood; per image, averaged.

    Units are those of prediction, target and raw: for flow give all three in training units, or pixels with a raw that
    was trained on pixels.
    """

    higher_is_better = False

    def __init__(self, name: str, loss: UncertaintyLoss, channels: int = 2) -> None:
        joint = loss.config.f.name in _JOINT
        likelihood = loss.likelihood(channels if joint else 1)  # ValueError where there is none
        super().__init__(f"{name}_{loss.describe()}")
        self.loss, self.channels, self._likelihood_name = loss, channels if joint else 1, likelihood.name

    def update(self, prediction: Tensor, raw: Tensor, target: Tensor, valid: Tensor | None = None) -> None:
        """Add a batch: prediction, target [N, C, H, W]; raw of that shape, or one channel; valid bool [N, H, W]."""
        if prediction.dim() != 4 or prediction.shape != target.shape:
            raise ValueError(
                f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)} must both be [N, C, H, W]."
            )
        mask = (target.abs() <= UNKNOWN_FLOW).all(dim=1)
        mask = mask if valid is None else mask & check_map("valid", valid, mask).bool()
        with torch.no_grad():
            values = self._values(prediction.double(), raw.double(), target.double())
        for image, chosen in zip(values, mask, strict=True):
            if chosen.any():
                self._add_pixels(image[:, chosen].flatten())

    def _values(self, prediction: Tensor, raw: Tensor, target: Tensor) -> Tensor:
        raise NotImplementedError


class NegativeLogLikelihood(_DensityMetric):
    """Mean of -log p(target | prediction, raw) in nats, per value of the loss's f: per axis, or over all axes together.

    Args:
        loss: an :class:`ajna.losses.UncertaintyLoss` that is a likelihood (``loss.likelihood()``).
        channels: of the prediction, for f over the channel axis (l2, squared_l2).

    Raises:
        ValueError: where the loss is no likelihood.
    """

    def __init__(self, loss: UncertaintyLoss, channels: int = 2) -> None:
        super().__init__("nll", loss, channels)

    def _values(self, prediction: Tensor, raw: Tensor, target: Tensor) -> Tensor:
        return self.loss.nll(prediction, raw, target)


class CRPS(_DensityMetric):
    """Mean continuous ranked probability score per component, in the unit of the prediction (0 is best).

    Args:
        loss, channels: as :class:`NegativeLogLikelihood`; Laplace and Gaussian likelihoods.

    Raises:
        ValueError: where the loss is no likelihood, or one without a closed form per component.
    """

    def __init__(self, loss: UncertaintyLoss, channels: int = 2) -> None:
        super().__init__("crps", loss, channels)
        if self._likelihood_name not in ("Laplace", "Gaussian"):
            raise ValueError(
                f"the CRPS of the {self._likelihood_name} distribution has no closed form per component; "
                "use NegativeLogLikelihood."
            )

    def _values(self, prediction: Tensor, raw: Tensor, target: Tensor) -> Tensor:
        return self.loss.crps(prediction, raw, target)
