# SPDX-License-Identifier: MIT
"""An adversarial patch against a flow network, found by gradient ascent through that network (white box)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ajna import nn
from ajna.studies.disturbances import Patch, StudyScene

__all__ = ["AttackOptions", "random_patch", "train_patch"]


@dataclass(frozen=True)
class AttackOptions:
    """side: of the patch, pixels. steps: of the ascent, each on ``batch`` scenes with places of their own. step: first
    change of a pixel, as a share of its range; it falls linearly to a tenth."""

    side: int = 50
    steps: int = 120
    batch: int = 2
    step: float = 0.08
    seed: int = 0

    def __post_init__(self) -> None:
        if self.side < 4 or self.steps < 1 or self.batch < 1 or not self.step > 0:
            raise ValueError(
                f"patch attack with side {self.side}, {self.steps} steps, batch {self.batch}, step {self.step}: give a "
                "side of at least 4, at least 1 step and scene, and a positive step"
            )


def random_patch(side: int, seed: int = 0) -> Patch:
    """Coarse coloured noise: what a patch of that size does without being optimised."""
    coarse = np.random.default_rng([seed, 0xAD]).integers(0, 256, (-(-side // 5), -(-side // 5), 3), dtype=np.uint8)
    return Patch(np.kron(coarse, np.ones((5, 5, 1), np.uint8))[:side, :side])


def train_patch(
    checkpoint: Path,
    scenes: Sequence[StudyScene],
    options: AttackOptions | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Patch:
    """The patch that changes the flow of the pixels outside of it the most, on average over places and scenes.

    The patch is fixed to the camera and lies in both frames; the objective is the mean change of flow outside of it
    (and of a margin of 4 pixels), in pixels, against the network's own flow without it. Ascent along the gradient's
    sign.

    Args:
        checkpoint: of the network to attack; scenes: to train on, none of which should be judged on later.

    Raises:
        ValueError: no scenes, or scenes smaller than the patch.
    """
    chosen = options or AttackOptions()
    if not scenes or min(scenes[0].boundary.shape) < chosen.side:
        raise ValueError(f"a patch of {chosen.side} px needs scenes of at least that size to train on")
    net, metadata = nn.load_checkpoint(checkpoint)
    scale = float(metadata["flow_scale"])
    random = np.random.default_rng([chosen.seed, 0xA77])
    first, second = (
        torch.from_numpy(np.stack([getattr(scene, name) for scene in scenes])).permute(0, 3, 1, 2).float()
        for name in ("frame1", "frame2")
    )
    with torch.no_grad():
        inputs = [nn.network_input(a[None], b[None]) for a, b in zip(first, second, strict=True)]
        calm = torch.cat([scale * net(pair)[:, :2] for pair in inputs])
    height, width = first.shape[2:]
    start = random_patch(chosen.side, chosen.seed).image
    patch = torch.from_numpy(start.astype(np.float32) / 255).permute(2, 0, 1).requires_grad_(True)
    for step in range(chosen.steps):
        picked = random.choice(len(scenes), min(chosen.batch, len(scenes)), replace=False)
        loss = torch.zeros(())
        for index in picked:
            x, y = int(random.integers(0, width - chosen.side + 1)), int(random.integers(0, height - chosen.side + 1))
            frames = []
            for frame in (first[index], second[index]):
                pasted = frame.clone()
                pasted[:, y : y + chosen.side, x : x + chosen.side] = 255 * patch
                frames.append(pasted[None] / 127.5 - 1)
            flow = scale * net(torch.cat(frames, dim=1))[:, :2]
            outside = torch.ones(height, width, dtype=torch.bool)
            outside[max(y - 4, 0) : y + chosen.side + 4, max(x - 4, 0) : x + chosen.side + 4] = False
            loss = loss + (flow - calm[index : index + 1]).norm(dim=1)[0][outside].mean()
        (gradient,) = torch.autograd.grad(loss, patch)
        size = chosen.step * (1 - 0.9 * step / chosen.steps)
        with torch.no_grad():
            patch += size * gradient.sign()
            patch.clamp_(0, 1)
        progress((step + 1) / chosen.steps)
    image = (255 * patch.detach()).round().to(torch.uint8).permute(1, 2, 0)
    return Patch(np.ascontiguousarray(image.numpy()))
