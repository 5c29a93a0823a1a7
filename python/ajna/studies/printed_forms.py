# SPDX-License-Identifier: MIT
"""What the rows of Table 3 that cannot be meant as printed do when they are minimised: predicted, then measured.

To isolate the loss there is no network here: every bin of errors has a prediction and a raw uncertainty of its own,
trained on fresh noise. Where raw must end follows from the curves of h and g alone, which is what check() looks at.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ajna import _core
from ajna.losses import AdmissibilityWarning, UncertaintyLoss, preset, presets
from ajna.studies.loss_study import MAX_DEVIATION
from ajna.studies.regression import NOISES, Task

Progress = Callable[[float], None]

#: Where raw starts. From 3 one printed form still works for large errors, from 0 for none.
STARTS = (0.0, 3.0)
#: Errors this close (relatively) to where a minimum vanishes are not judged: there the pull on raw is nearly zero.
_MARGIN = 0.15


def inadmissible_presets() -> list[str]:
    """Names of the published forms whose check fails."""
    return [p.name for p in presets() if not _core.UncertaintyLoss(p.config).check().admissible]


@dataclass
class PrintedOptions:
    """How the bins are trained; the defaults take about ten seconds."""

    noises: list[str] = field(default_factory=lambda: list(NOISES))
    seed: int = 0
    scales: int = 12  # bins, spread from 0.3 to 3 times the noise's unit deviation
    samples: int = 256  # per bin and step
    steps: int = 1000
    lr: float = 0.04
    draws: int = 20_000  # noise samples that E[f] is measured with


@dataclass
class PrintedResult:
    """One printed form from one start of raw, all noises together; tensors are [noises, bins], float64."""

    preset: str
    start: float
    reason: str  # check()'s sentence
    scales: Tensor
    attainable: Tensor  # E[f] of the centre of the noise: what a sound loss would leave
    measured: Tensor  # E[f] of the trained prediction
    raw: Tensor  # where raw has ended
    predicted: Tensor  # where raw must end: -inf where it leaves the domain downwards
    expected: Tensor  # kappa(raw)
    raw_min: float
    repels: bool  # h < 0: predictions are pushed away from their targets
    judged: Tensor  # bool: not within 15 % of an error at which a minimum vanishes

    @property
    def leaves(self) -> Tensor:
        """Bins whose raw is predicted to leave the domain downwards, whatever their error; bool."""
        return self.predicted.isneginf() & self.judged

    @property
    def stays(self) -> Tensor:
        """Bins for which a minimum lies downhill from the start; bool."""
        return self.predicted.isfinite() & self.judged

    def sentence(self) -> str:
        """The prediction in words."""
        if self.repels:
            return "h < 0 rewards errors: predictions turn away from their targets, beyond a right angle"
        left, kept = int(self.leaves.sum()), int(self.stays.sum())
        if kept == 0:
            return f"no minimum downhill: raw leaves the domain, whatever the error ({left} of {left + kept} bins)"
        floor = float(self.attainable[self.stays].min())
        return (
            f"no minimum for small errors: raw leaves the domain ({left} of {left + kept} bins); a local one holds the "
            f"rest (E[f] from {floor:.2f})"
        )

    def outcome(self) -> str:
        """What was measured, in the same words."""
        if self.repels:
            low, high = float(self.measured.min()), float(self.measured.max())
            best = float(self.attainable.max())
            return (
                f"mean angle {math.degrees(low):.0f} to {math.degrees(high):.0f} degrees, where "
                f"{math.degrees(best):.0f} or less could be had"
            )
        parts = []
        if self.leaves.any():
            gone = int((self.raw[self.leaves] < self.raw_min).sum())
            parts.append(f"{gone} of {int(self.leaves.sum())} below raw = {self.raw_min:g}")
        if self.stays.any():
            worst = float((self.expected / self.measured - 1.0)[self.stays].abs().max())
            parts.append(f"kappa within {100 * worst:.1f} % of E[f] in the other {int(self.stays.sum())}")
        return "; ".join(parts)

    @property
    def holds(self) -> bool:
        """Whether what was predicted was measured."""
        if self.repels:
            return bool((self.measured > math.pi / 2).all()) and bool((self.measured > self.attainable).all())
        gone = bool((self.raw[self.leaves] < self.raw_min).all())
        near = bool(((self.expected / self.measured - 1.0)[self.stays].abs() <= MAX_DEVIATION).all())
        return gone and near


def downhill(loss: UncertaintyLoss, error: Tensor, start: float) -> Tensor:
    """Where gradient descent in raw ends for a mean error: the first local minimum of h E[f] + lam g from `start`.

    Args:
        loss: any loss, admissible or not.
        error: E[f], any shape.
        start: raw at the beginning, inside check()'s domain.

    Returns:
        raw of that minimum, or -inf (inf) where there is none before the lower (upper) end of the domain; float64.
    """
    report = loss.check()
    raw = torch.linspace(report.raw_min, report.raw_max, 64 * 74 + 1, dtype=torch.float64)
    curves = loss.curves(raw)
    ends = []
    for value in error.double().flatten():
        slope = curves["h_slope"] * value + loss.config.lam * curves["g_slope"]
        here = int((raw - start).abs().argmin())
        if slope[here] > 0:  # downhill is to the left, until the slope is no longer positive
            left = (slope[:here] <= 0).nonzero()
            ends.append(float(raw[left[-1, 0]]) if left.numel() else -math.inf)
        else:
            right = (slope[here:] > 0).nonzero()
            ends.append(float(raw[here + right[0, 0]]) if right.numel() else math.inf)
    return torch.tensor(ends, dtype=torch.float64).reshape(error.shape)


def _train(
    loss: UncertaintyLoss, task: Task, scales: Tensor, start: float, options: PrintedOptions
) -> tuple[Tensor, Tensor]:
    """prediction, raw [noises, bins] after gradient descent."""
    generator = torch.Generator().manual_seed(options.seed)
    shape = (len(options.noises), scales.numel())
    # Slightly off the noise's centre: at its exact antipode or target an angle has no direction to move in.
    prediction = torch.full(shape, 0.1 * task.unit, requires_grad=True)
    raw = torch.full(shape, start, requires_grad=True)
    # A short memory: on its way out of the domain raw meets gradients that shrink by orders of magnitude.
    optimizer = torch.optim.Adam([prediction, raw], lr=options.lr, betas=(0.8, 0.9))
    for step in range(options.steps):
        noise = torch.stack([NOISES[name]((scales.numel(), options.samples), generator) for name in options.noises])
        target = task.unit * scales[:, None] * noise
        full = prediction[..., None].expand_as(target)
        value = loss(task.shaped(full), raw[..., None].expand_as(target).reshape(-1, 1), task.shaped(target))
        for group in optimizer.param_groups:
            group["lr"] = options.lr * (0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * step / options.steps)))
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    return prediction.detach(), raw.detach().double()


def _judged(loss: UncertaintyLoss, error: Tensor, start: float) -> Tensor:
    """Whether the fate of raw is the same for errors 15 % lower and higher."""
    fates = [downhill(loss, error * factor, start).isfinite() for factor in (1.0 - _MARGIN, 1.0, 1.0 + _MARGIN)]
    return (fates[0] == fates[1]) & (fates[1] == fates[2])


def run(options: PrintedOptions | None = None, progress: Progress = lambda share: None) -> list[PrintedResult]:
    """Predict and measure the end of every inadmissible printed form, from both starts of raw."""
    options = options or PrintedOptions()
    scales = torch.logspace(math.log10(0.3), math.log10(3.0), options.scales)
    results: list[PrintedResult] = []
    work = [(name, start) for name in inadmissible_presets() for start in STARTS]
    for number, (name, start) in enumerate(work):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AdmissibilityWarning)  # known, and the subject
            loss = preset(name)
        task, report = Task(loss), loss.check()
        prediction, raw = _train(loss, task, scales, start, options)
        generator = torch.Generator().manual_seed(options.seed + 1)
        noise = torch.stack([NOISES[kind]((1, options.draws), generator) for kind in options.noises])
        target = task.unit * scales[:, None] * noise
        attainable = task.error(torch.zeros(()), target).double().mean(-1)
        domain = torch.linspace(report.raw_min, report.raw_max, 100, dtype=torch.float64)
        results.append(
            PrintedResult(
                preset=name,
                start=start,
                reason=report.reason,
                scales=scales.double(),
                attainable=attainable,
                measured=task.error(prediction[..., None], target).double().mean(-1),
                raw=raw,
                predicted=downhill(loss, attainable, start),
                expected=loss.expected_error(raw),
                raw_min=report.raw_min,
                repels=bool((loss.curves(domain)["h"] < 0).all()),
                judged=_judged(loss, attainable, start),
            )
        )
        progress((number + 1) / len(work))
    return results
