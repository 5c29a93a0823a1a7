# SPDX-License-Identifier: MIT
"""Does a loss's uncertainty mean what kappa says? One small network per published loss and noise, trained and measured.

For an admissible loss the trained network must say, at every x, how large its own expected error is: kappa(Y) = E[f],
whatever the noise's distribution. The printed forms that cannot be meant so are in :mod:`ajna.studies.printed_forms`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from ajna import _core
from ajna.losses import UncertaintyLoss, preset, presets
from ajna.studies import regression
from ajna.studies.regression import NOISES, Stratified, Task

#: What must hold on the grid of x for every admissible preset and every noise.
MIN_RHO = 0.95
MAX_DEVIATION = 0.10
#: Networks are judged on X_MIN to X_MAX and trained a little beyond, so that every place has data on both sides.
TRAINED_X = 1.2

Progress = Callable[[float], None]


def admissible_presets() -> list[str]:
    """Names of the published losses whose check passes."""
    return [entry.name for entry in presets() if _core.UncertaintyLoss(entry.config).check().admissible]


@dataclass
class StudyOptions:
    """How the networks are trained and measured; the defaults take one to two minutes on two cores."""

    presets: list[str] = field(default_factory=admissible_presets)
    noises: list[str] = field(default_factory=lambda: list(NOISES))
    seed: int = 0
    steps: int = 2500
    batch: int = 96  # places of x per step
    samples: int = 16  # noise samples at each of them, spread over the distribution
    hidden: int = 24
    lr: float = 0.02
    averaged: float = 0.35  # the last part of the steps, over which the weights are averaged
    grid: int = 41  # points of x
    draws: int = 60_000  # noise samples per point that E[f] is measured with

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "samples", "hidden", "draws"):
            if getattr(self, name) < 1:
                raise ValueError(f"study option {name} = {getattr(self, name)}: give at least 1")
        if self.grid < 3:
            raise ValueError(f"study option grid = {self.grid}: give at least 3 points")
        for name in self.noises:
            if name not in NOISES:
                near = _core.nearest_name(name, list(NOISES))
                hint = f", did you mean '{near}'?" if near else ""
                raise ValueError(f"unknown noise '{name}'{hint} Known: {', '.join(NOISES)}")


@dataclass
class Cell:
    """One loss under one noise, on the grid of x; [grid] each, float64."""

    presets: list[str]  # the published losses with these terms
    noise: str
    x: Tensor
    prediction: Tensor
    raw: Tensor
    penalty: Tensor  # g(a), which UncertaintyLoss.uncertainty gives
    uncertainty: Tensor  # Y: Table 3's a (1/a where a is a confidence, which falls as the error rises)
    expected: Tensor  # kappa(Y), what the network says
    measured: Tensor  # E[f] of its own prediction, measured on fresh noise

    @property
    def rho(self) -> float:
        """Pearson correlation of Y and E[f] over the grid."""
        return float(torch.corrcoef(torch.stack([self.uncertainty, self.measured]))[0, 1])

    @property
    def rho_of_g(self) -> float:
        """The same with g(a) in place of Y: below rho where g is a logarithm, which is not linear in the error."""
        return float(torch.corrcoef(torch.stack([self.penalty, self.measured]))[0, 1])

    @property
    def mean_deviation(self) -> float:
        """The mean |kappa(Y) / E[f] - 1| over the grid."""
        return float((self.expected / self.measured - 1.0).abs().mean())

    @property
    def deviation(self) -> float:
        """The largest |kappa(Y) / E[f] - 1| over the grid."""
        return float((self.expected / self.measured - 1.0).abs().max())

    @property
    def holds(self) -> bool:
        """Whether the claim holds: rho > 0.95 and kappa(Y) within 10 % of E[f] everywhere on the grid."""
        return self.rho > MIN_RHO and self.deviation <= MAX_DEVIATION


class Networks(nn.Module):
    """`count` independent networks x -> (prediction, raw) of two hidden layers, evaluated together.

    Batching them changes the speed alone: the loss is a sum of theirs and Adam works per parameter.
    """

    def __init__(self, count: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        sizes = (1, hidden, hidden, 2)

        def uniform(*shape: int, bound: float) -> nn.Parameter:
            # The same start for every network, so that they differ in loss and noise alone.
            start = (torch.rand(1, *shape, generator=generator) * 2.0 - 1.0) * bound
            return nn.Parameter(start.expand(count, *shape).clone())

        pairs = list(itertools.pairwise(sizes))
        # x is one number in [-1, 1]: the first layer's kinks are spread over that range.
        self.weights = nn.ParameterList(uniform(a, b, bound=3.0 if a == 1 else math.sqrt(3.0 / a)) for a, b in pairs)
        self.biases = nn.ParameterList(uniform(1, b, bound=3.0 if a == 1 else 0.0) for a, b in pairs)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x [B] -> prediction [count, B], raw [count, B]."""
        out = (x[:, None] * self.weights[0] + self.biases[0]).tanh()
        for weight, bias in zip(self.weights[1:-1], self.biases[1:-1], strict=True):
            out = torch.baddbmm(bias, out, weight).tanh()
        out = torch.baddbmm(self.biases[-1], out, self.weights[-1])
        return out[..., 0], out[..., 1]


def _learning_rate(step: int, options: StudyOptions) -> float:
    """Factor of the rate: a short rise, then half a cosine down to 2 %."""
    rise = min(1.0, (step + 1) / (0.05 * options.steps))
    return rise * (0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * step / options.steps)))


def same_loss(names: list[str]) -> list[list[str]]:
    """Presets grouped by their loss: several papers use the same terms, and one training speaks for all of them."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(preset(name).describe(), []).append(name)
    return list(groups.values())


def _train(options: StudyOptions, losses: list[UncertaintyLoss], tasks: list[Task], progress: Progress) -> Networks:
    """Networks in the order (preset, noise), with weights averaged over the last steps."""
    generator = torch.Generator().manual_seed(options.seed)
    kinds = len(options.noises)
    networks = Networks(len(losses) * kinds, options.hidden, generator)
    optimizer = torch.optim.Adam(networks.parameters(), lr=options.lr)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _learning_rate(step, options))
    average = torch.optim.swa_utils.AveragedModel(networks)
    sources = [Stratified(NOISES[name], generator) for name in options.noises]
    strata = torch.arange(options.batch) / options.batch
    for step in range(options.steps):
        # Evenly spread x with a random offset, and new noise in every step: there is no training set to overfit.
        x = TRAINED_X * (2.0 * (strata + torch.rand((), generator=generator) / options.batch) - 1.0)
        noise = torch.stack([source((options.batch, options.samples), generator) for source in sources])
        spread, centre = regression.scale(x)[:, None] * noise, regression.mean(x)[:, None]
        prediction, raw = (out[..., None].expand(-1, -1, options.samples) for out in networks(x))
        total = torch.zeros(())
        for index, (loss, task) in enumerate(zip(losses, tasks, strict=True)):
            rows = slice(index * kinds, (index + 1) * kinds)
            target = centre + task.unit * spread
            total = total + loss(task.shaped(prediction[rows]), raw[rows].reshape(-1, 1), task.shaped(target))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        if step >= (1.0 - options.averaged) * options.steps:
            average.update_parameters(networks)
        progress((step + 1) / options.steps)
    averaged = average.module
    assert isinstance(averaged, Networks)
    return averaged


def uncertainty(config: _core.LossConfig, raw: Tensor) -> Tensor:
    """Y: Table 3's a = parametrization(raw), or 1/a where a is a confidence; the shape of raw."""
    plain = _core.LossConfig()
    plain.g, plain.parametrization = _core.TermSpec("identity"), config.parametrization
    a = _core.UncertaintyLoss(plain).uncertainty(raw)
    return a.reciprocal() if config.parametrization.name == "confidence" else a


def run(options: StudyOptions | None = None, progress: Progress = lambda share: None) -> list[Cell]:
    """Train a network for every preset under every noise and measure it on a grid of x.

    Args:
        options: what to train and how.
        progress: called with the share done, 0 to 1.

    Raises:
        ValueError: for an unknown preset or noise (with the nearest known one).
    """
    options = options or StudyOptions()
    groups = same_loss(options.presets)
    losses = [preset(names[0]) for names in groups]
    tasks = [Task(loss) for loss in losses]
    networks = _train(options, losses, tasks, progress)
    x = torch.linspace(regression.X_MIN, regression.X_MAX, options.grid)
    with torch.no_grad():
        predictions, raws = networks(x)
    generator = torch.Generator().manual_seed(options.seed + 1)
    samples = {name: NOISES[name]((1, options.draws), generator) for name in options.noises}
    cells = []
    for index, (names, loss, task) in enumerate(zip(groups, losses, tasks, strict=True)):
        for offset, noise in enumerate(options.noises):
            row = index * len(options.noises) + offset
            prediction, raw = predictions[row], raws[row].double()
            target = regression.mean(x)[:, None] + task.unit * regression.scale(x)[:, None] * samples[noise]
            cells.append(
                Cell(
                    presets=names,
                    noise=noise,
                    x=x.double(),
                    prediction=prediction.double(),
                    raw=raw,
                    penalty=loss.uncertainty(raw),
                    uncertainty=uncertainty(loss.config, raw),
                    expected=loss.expected_error(raw),
                    measured=task.error(prediction[:, None], target).double().mean(1),
                )
            )
    return cells
