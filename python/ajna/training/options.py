# SPDX-License-Identifier: MIT
"""What a training config chooses, group by group; unknown keys are refused by the parser."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

from ajna import _core
from ajna.losses import UncertaintyLoss
from ajna.nn import FlowNet, NetConfig

_NET = NetConfig()
_LOSS = _core.LossConfig()

Term = str | dict[str, Any]


@dataclass
class NetOptions:
    """Shape of the network."""

    width: int = _NET.width
    expansion: int = _NET.expansion
    sub_blocks: int = _NET.sub_blocks
    skip_connections: bool = bool(_NET.skip_connections)
    scale_heads: bool = bool(_NET.scale_heads)
    correlation_radius: int = _NET.correlation_radius

    def build(self) -> FlowNet:
        return FlowNet(**vars(self))


@dataclass
class LossOptions:
    """The uncertainty loss, and how the flow is led to it.

    The raw uncertainty learns from the first step on, by the uncertainty loss. The flow begins with plain L1 (with the
    uncertainty loss's weights still meaningless, hard pixels would be written off), and is handed over to the
    uncertainty loss between ``l1_steps`` and ``l1_steps + blend_steps``; ``l1_share`` of L1 remains for good.
    ``raw_gradient`` scales the raw uncertainty's gradient until the hand-over: below 1, the shared layers first learn
    to match. ``occluded_weight`` weighs pixels that are hidden in frame 2. With a network that predicts at several
    scales, each coarser prediction counts ``coarser_weight`` times the next finer one.
    """

    f: Term = _LOSS.f.name
    h: Term = _LOSS.h.name
    g: Term = _LOSS.g.name
    lam: float = _LOSS.lam
    parametrization: Term = _LOSS.parametrization.name
    l1_steps: int = 1000
    blend_steps: int = 2000
    l1_share: float = 0.0
    raw_gradient: float = 1.0
    occluded_weight: float = 1.0
    coarser_weight: float = 0.5

    def __post_init__(self) -> None:
        _require(self.l1_steps >= 0, "loss.l1_steps", self.l1_steps, "give 0 or more")
        _require(self.blend_steps >= 0, "loss.blend_steps", self.blend_steps, "give 0 or more")
        _require(0 <= self.l1_share <= 1, "loss.l1_share", self.l1_share, "give 0 to 1")
        _require(self.raw_gradient > 0, "loss.raw_gradient", self.raw_gradient, "give a number above 0")
        _require(self.occluded_weight >= 0, "loss.occluded_weight", self.occluded_weight, "give 0 or more")
        _require(self.coarser_weight >= 0, "loss.coarser_weight", self.coarser_weight, "give 0 or more")

    def build(self) -> UncertaintyLoss:
        return UncertaintyLoss(self.f, self.h, self.g, self.lam, self.parametrization)

    def handover(self, step: int) -> float:
        """0 before ``l1_steps``, 1 from ``l1_steps + blend_steps`` on, smooth between."""
        if step < self.l1_steps:
            return 0.0
        t = min((step - self.l1_steps) / self.blend_steps, 1.0) if self.blend_steps else 1.0
        return t * t * (3.0 - 2.0 * t)

    def flow_share(self, step: int) -> float:
        """Share of the uncertainty loss in the flow's gradient at ``step``, 0 to 1 - l1_share; the rest is L1."""
        return self.handover(step) * (1.0 - self.l1_share)

    def raw_share(self, step: int) -> float:
        """Factor of the raw uncertainty's gradient at ``step``: ``raw_gradient``, then 1."""
        return self.raw_gradient + self.handover(step) * (1.0 - self.raw_gradient)


@dataclass
class GuidanceOptions:
    """Aids for the start (see ajna.training.guidance).

    ``motion_energy`` sets the first convolution; heads on inner layers add ``heads_weight`` times their L1 loss,
    falling to ``heads_final`` times that over ``heads_steps`` steps.
    """

    motion_energy: bool = True
    heads_weight: float = 1.0
    heads_final: float = 0.1
    heads_steps: int = 8000

    def __post_init__(self) -> None:
        _require(self.heads_weight >= 0, "guidance.heads_weight", self.heads_weight, "give 0 (no heads) or more")
        _require(0 <= self.heads_final <= 1, "guidance.heads_final", self.heads_final, "give 0 to 1")
        _require(self.heads_steps >= 1, "guidance.heads_steps", self.heads_steps, "give at least 1")

    def weight_at(self, step: int) -> float:
        """Weight of the heads' loss at ``step``: half a cosine from ``heads_weight`` down."""
        t = min(1.0, step / self.heads_steps)
        return self.heads_weight * (self.heads_final + (1 - self.heads_final) * 0.5 * (1 + math.cos(math.pi * t)))


@dataclass
class OptimOptions:
    """Optimizer, learning rate over steps, clipping and weight averaging.

    The rate rises linearly over ``warmup_steps``, then follows ``schedule``: ``cosine`` falls by half a cosine to
    ``final_lr_ratio * lr`` at the last step; ``step`` is multiplied by ``gamma`` at each of ``milestones``, which are
    shares of the run (0.5 is half-way); ``constant`` stays. ``gradient_clip`` bounds the 2-norm of the network's
    gradient; null leaves it. ``ema_decay`` 0 ships the weights themselves instead of their average.
    """

    optimizer: str = "adamw"
    lr: float = 4e-4
    weight_decay: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    schedule: str = "cosine"
    warmup_steps: int = 500
    final_lr_ratio: float = 0.01
    milestones: list[float] = field(default_factory=lambda: [0.5, 0.75])
    gamma: float = 0.5
    gradient_clip: float | None = 1.0
    ema_decay: float = 0.999
    max_bad_steps: int = 20

    def __post_init__(self) -> None:
        _require(self.optimizer in ("adamw", "adam"), "optim.optimizer", self.optimizer, "give adamw or adam")
        _require(math.isfinite(self.lr) and self.lr > 0, "optim.lr", self.lr, "give a number above 0")
        _require(self.warmup_steps >= 0, "optim.warmup_steps", self.warmup_steps, "give 0 or more")
        schedules = ("cosine", "step", "constant")
        _require(self.schedule in schedules, "optim.schedule", self.schedule, f"give {', '.join(schedules)}")
        _require(0 <= self.final_lr_ratio <= 1, "optim.final_lr_ratio", self.final_lr_ratio, "give 0 to 1")
        rising = all(0 < a < b < 1 for a, b in itertools.pairwise([*self.milestones, 1 - 1e-12]))
        _require(rising, "optim.milestones", self.milestones, "give rising shares of the run, between 0 and 1")
        _require(0 < self.gamma <= 1, "optim.gamma", self.gamma, "give a number above 0, at most 1")
        clip = self.gradient_clip
        _require(clip is None or clip > 0, "optim.gradient_clip", clip, "give a number above 0, or null")
        _require(0 <= self.ema_decay < 1, "optim.ema_decay", self.ema_decay, "give 0 (off) to below 1")
        _require(self.max_bad_steps >= 1, "optim.max_bad_steps", self.max_bad_steps, "give at least 1")

    def lr_at(self, step: int, total_steps: int) -> float:
        """The learning rate of ``step`` (from 0) in a run of ``total_steps``."""
        if step < self.warmup_steps:
            return self.lr * (step + 1) / self.warmup_steps
        if self.schedule == "constant":
            return self.lr
        if self.schedule == "step":
            return self.lr * self.gamma ** sum(step >= share * total_steps for share in self.milestones)
        t = min(1.0, (step - self.warmup_steps) / max(total_steps - self.warmup_steps, 1))
        return self.lr * (self.final_lr_ratio + (1 - self.final_lr_ratio) * 0.5 * (1 + math.cos(math.pi * t)))


@dataclass
class Stage:
    """One step of the curriculum, from ``from_step`` until the next stage begins.

    ``motion`` multiplies the scene's flow_mean_px and flow_max_px; ``scene`` options replace those of the run. With
    ``reuse`` K > 1, ``pool`` generated batches are used K times each, shuffled among each other, flipped, transposed
    (square crops) and with permuted colour channels, all exact for the flow.
    """

    from_step: int
    height: int
    width: int
    batch: int
    motion: float = 1.0
    reuse: int = 1
    pool: int = 8
    scene: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require(self.from_step >= 0, "stage.from_step", self.from_step, "give 0 or more")
        for name in ("height", "width", "batch", "reuse", "pool"):
            _require(getattr(self, name) >= 1, f"stage.{name}", getattr(self, name), "give at least 1")
        _require(math.isfinite(self.motion) and self.motion > 0, "stage.motion", self.motion, "give a number above 0")


@dataclass
class ValidationOptions:
    """The fixed validation scenes: ``batches`` batches of ``batch`` pairs, the same in every run."""

    batches: int = 4
    batch: int = 8
    height: int = 240
    width: int = 320
    scene: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("batches", "batch", "height", "width"):
            _require(getattr(self, name) >= 1, f"validation.{name}", getattr(self, name), "give at least 1")


def check_stages(stages: list[Stage]) -> list[Stage]:
    """The stages in order; raises ValueError unless the first begins at 0 and each begins after the one before."""
    _require(bool(stages), "data.stages", "[]", "give at least one stage")
    _require(stages[0].from_step == 0, "from_step of the first stage", stages[0].from_step, "give 0")
    for before, after in itertools.pairwise(stages):
        _require(before.from_step < after.from_step, "stage.from_step", after.from_step, "give rising steps")
    return stages


def _require(ok: bool, name: str, value: Any, remedy: str) -> None:
    if not ok:
        raise ValueError(f"training option {name} = {value}: {remedy}")
