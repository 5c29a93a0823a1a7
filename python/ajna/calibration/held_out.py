# SPDX-License-Identifier: MIT
"""How well expected errors and intervals hold on images that nothing was fitted on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ajna._core import ConformalFactors
from ajna.metrics import Coverage, CoverageCurve, Reliability, ReliabilityCurve

LAPLACE = "Laplace distribution"
CONFORMAL = "conformal"


def laplace_factors(levels: Sequence[float]) -> ConformalFactors:
    """The factors if errors were Laplace distributed with the expected error as their mean: -log(1 - p)."""
    return ConformalFactors(list(levels), [(-math.log1p(-p),) * 2 for p in levels])


class HeldOut:
    """Reliability and coverage, streaming over images; each image has the same weight.

    Args:
        levels: shares of the intervals.
        factors: calibrated ones; where they are None or do not reach the levels, those of a Laplace distribution.
    """

    def __init__(self, levels: Sequence[float], factors: ConformalFactors | None) -> None:
        reached = factors is not None and factors.levels[0] <= levels[0] and levels[-1] <= factors.levels[-1]
        self.intervals_from = CONFORMAL if reached else LAPLACE
        if factors is None or not reached:
            factors = laplace_factors(levels)
        self._reliability = Reliability()
        self._coverage = Coverage(levels, [factors.at(p) for p in levels])

    def add(self, flow: Tensor, truth: Tensor, expected_error: Tensor, valid: Tensor) -> None:
        """One image: flow, truth, expected_error [2, H, W] px, valid bool [H, W]."""
        batch = [tensor.cpu()[None] for tensor in (flow, truth, expected_error, valid)]
        self._reliability.update(*batch)
        self._coverage.update(*batch)

    @property
    def reliability(self) -> ReliabilityCurve:
        """Expected against observed error."""
        return self._reliability.compute()

    @property
    def coverage(self) -> CoverageCurve:
        """Share of flow components inside the intervals, and their width."""
        curve = self._coverage.compute()
        # torchmetrics makes a scalar of a curve of one level.
        levels, coverage, width = (values.reshape(-1) for values in curve[:3])
        return CoverageCurve(levels, coverage, width, curve.error)

    def to_json(self) -> dict[str, Any]:
        """Plain keys and numbers."""
        reliability, coverage = self.reliability, self.coverage
        filled = reliability.weight > 0
        return {
            "ece_px": reliability.ece.item(),
            "ence": reliability.ence.item(),
            "intervals_from": self.intervals_from,
            "levels": coverage.levels.tolist(),
            "coverage": coverage.coverage.tolist(),
            "width_px": coverage.width.tolist(),
            "reliability": {
                "weight": reliability.weight[filled].tolist(),
                "expected_px": reliability.expected[filled].tolist(),
                "observed_px": reliability.observed[filled].tolist(),
            },
        }


def as_tensor(array: Any, device: torch.device | str) -> Tensor:
    """[H, W, C] -> [C, H, W] on the device."""
    return torch.from_numpy(array).permute(2, 0, 1).to(device)
