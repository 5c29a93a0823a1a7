# SPDX-License-Identifier: MIT
"""The scores of a validation, summed over its batches and over processes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import MeanMetric, Metric

from ajna.metrics import AUSE, EndPointError, OcclusionAUC, Spearman


class ValidationScores:
    """What a network's flow and uncertainty are worth; conventions as in ``ajna.metrics``."""

    def __init__(self, device: torch.device | str) -> None:
        self.epe, self.zero, self.ause = EndPointError(), EndPointError(), AUSE()
        self.spearman, self.occlusion_auc = Spearman(), OcclusionAUC()
        self.loss = MeanMetric(nan_strategy="disable")
        self.error, self.expected = MeanMetric(nan_strategy="disable"), MeanMetric(nan_strategy="disable")
        self._has_occlusion = False
        for metric in vars(self).values():
            if isinstance(metric, Metric):
                metric.to(device)

    def update(
        self, flow: Tensor, batch: dict[str, Any], uncertainty: Tensor, expected_error: Tensor, loss: Tensor
    ) -> None:
        """Add a batch.

        Args:
            flow, expected_error: [N, 2, H, W] px.
            batch: ``flow`` [N, 2, H, W] px, and if there are such ``valid`` and ``occlusion`` bool [N, 1, H, W].
            uncertainty: [N, 2, H, W].
            loss: of the batch.
        """
        truth, valid = batch["flow"], batch.get("valid")
        self.epe.update(flow, truth, valid)
        self.zero.update(torch.zeros_like(flow), truth, valid)
        for metric in (self.ause, self.spearman):
            metric.update(flow, truth, uncertainty, valid)
        if (occlusion := batch.get("occlusion")) is not None:
            self._has_occlusion = True
            self.occlusion_auc.update(uncertainty, occlusion, valid)
        error = (flow - truth).abs()
        if valid is not None:
            seen = valid.expand_as(error)
            error, expected_error = error[seen], expected_error[seen]
        pixels = error.numel()
        if pixels:
            self.loss.update(loss, pixels)
            self.error.update(error.mean(), pixels)
            self.expected.update(expected_error.mean(), pixels)

    def compute(self) -> dict[str, float]:
        """epe (px), epe_ratio (to zero flow's), ause, spearman, loss; occlusion_auc, if there are occlusion masks; and
        expected_ratio: mean expected over mean actual error per axis, 1 where the uncertainty is right on average."""
        values = {name: float(getattr(self, name).compute()) for name in ("epe", "ause", "spearman", "loss")}
        values["epe_ratio"] = values["epe"] / float(self.zero.compute())
        values["expected_ratio"] = float(self.expected.compute() / self.error.compute())
        if self._has_occlusion:
            values["occlusion_auc"] = float(self.occlusion_auc.compute())
        return values
