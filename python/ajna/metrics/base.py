# SPDX-License-Identifier: MIT
"""What all metrics share: running sums, and the checks of what they are fed."""

from __future__ import annotations

import re
from typing import Literal

import torch
from torch import Tensor

from ajna.metrics.functions import UNKNOWN_FLOW

try:
    from torchmetrics import Metric
except ModuleNotFoundError as error:
    raise ImportError(
        f"scores need the Python package torchmetrics ({error}): pip install torchmetrics", name="ajna.metrics"
    ) from error

Average = Literal["image", "pixel"]


class RunningMean(Metric):
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


def check_map(name: str, value: Tensor, like: Tensor) -> Tensor:
    """[N, H, W] or [N, 1, H, W] -> [N, H, W], sizes equal to those of `like` [N, H, W]."""
    squeezed = value[:, 0] if value.dim() == 4 and value.shape[1] == 1 else value
    if squeezed.shape != like.shape:
        raise ValueError(
            f"{name} has shape {tuple(value.shape)}, but the images are {tuple(like.shape)} (N, H, W); pass a map of "
            "that size, with or without a channel axis of 1."
        )
    return squeezed


def scored_pixels(prediction: Tensor, target: Tensor, valid: Tensor | None) -> Tensor:
    """Mask [N, H, W] of the pixels that have ground truth and are wanted."""
    if prediction.dim() != 4 or prediction.shape[1] != 2 or prediction.shape != target.shape:
        raise ValueError(
            f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)} must both be [N, 2, H, W]."
        )
    known = (target.abs() <= UNKNOWN_FLOW).all(dim=1)  # false for NaN and Inf, too
    return known if valid is None else known & check_map("valid", valid, known).bool()
