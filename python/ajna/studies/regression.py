# SPDX-License-Identifier: MIT
"""One-dimensional regression whose noise depends on the place: where a loss's uncertainty can be held against truth.

y = mean(x) + scale(x) e with noise e of mean 0 and variance 1, in five shapes. Everything about it is known, so that
the expected error at a place can be measured to any precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ajna.losses import UncertaintyLoss

#: The x at which networks are judged.
X_MIN, X_MAX = -1.0, 1.0


def mean(x: Tensor) -> Tensor:
    """E[y] at x, any shape."""
    return torch.sin(3.0 * x)


def scale(x: Tensor) -> Tensor:
    """Standard deviation of y at x: 0.6 at x = -1 and 1, 2 at x = 0."""
    return 0.6 + 0.7 * (1.0 + torch.cos(math.pi * x))


def _normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=generator)


def _exponential(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.empty(shape).exponential_(generator=generator)


def _laplace(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return (_exponential(shape, generator) - _exponential(shape, generator)) / math.sqrt(2.0)


def _student_t(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    freedom = 5  # the fewest degrees for which the mean of squared errors can be measured: its variance is finite
    chi_square = _normal((*shape, freedom), generator).square().sum(-1)
    return _normal(shape, generator) / (chi_square / freedom).sqrt() * math.sqrt((freedom - 2) / freedom)


def _skewed(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return (_exponential(shape, generator) + _exponential(shape, generator) - 2.0) / math.sqrt(2.0)


def _bimodal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    mode = 0.95
    sign = torch.randint(0, 2, shape, generator=generator) * 2.0 - 1.0
    return mode * sign + math.sqrt(1.0 - mode * mode) * _normal(shape, generator)


#: Name -> samples(shape, generator), float32, mean 0, variance 1: Gaussian; Laplace; Student's t of 5 degrees of
#: freedom; a gamma distribution of shape 2, shifted; two Gaussians of deviation 0.31 at -0.95 and 0.95.
NOISES: dict[str, Callable[[tuple[int, ...], torch.Generator], Tensor]] = {
    "gaussian": _normal,
    "laplace": _laplace,
    "student_t": _student_t,
    "skewed": _skewed,
    "bimodal": _bimodal,
}


class Stratified:
    """Samples of a noise whose last axis covers its distribution evenly, one sample from each of its equal parts.

    The mean over that axis has the noise's expectation with far less variance than independent samples: what remains of
    a gradient's noise would otherwise hide whether the loss's minimum is where kappa says.
    """

    _BANK = 1 << 17

    def __init__(self, noise: Callable[[tuple[int, ...], torch.Generator], Tensor], generator: torch.Generator) -> None:
        self._sorted = noise((self._BANK,), generator).sort().values

    def __call__(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Float32 samples of `shape`; those along the last axis are in ascending order."""
        parts = torch.arange(shape[-1]) + torch.rand(shape, generator=generator)
        index = (parts * (self._BANK / shape[-1])).long().clamp_(max=self._BANK - 1)
        return self._sorted[index]


_ANGLE = 0.12  # radians per unit of the noise's scale where the target is a direction


class Task:
    """The regression as one loss sees it: its f, its prediction and its target.

    A loss on angles (``f = angular``) is given directions (cos y, sin y) with y in units of 0.12 rad; all others the
    number itself.
    """

    def __init__(self, loss: UncertaintyLoss) -> None:
        self.loss = loss
        self.directions = loss.config.f.name == "angular"
        self.unit = _ANGLE if self.directions else 1.0

    def shaped(self, y: Tensor) -> Tensor:
        """Any shape, y in the task's units -> [M, C]: what the loss takes as prediction or target."""
        y = y.reshape(-1, 1)
        return torch.cat([y.cos(), y.sin()], 1) if self.directions else y

    def error(self, prediction: Tensor, target: Tensor) -> Tensor:
        """f(prediction, target) for y in the task's units, broadcast against each other."""
        prediction, target = torch.broadcast_tensors(prediction, target)
        return self.loss.error(self.shaped(prediction), self.shaped(target)).reshape(prediction.shape)
