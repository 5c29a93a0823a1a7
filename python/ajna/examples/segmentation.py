# SPDX-License-Identifier: MIT
"""Semantic segmentation: one image in, class logits out, by attenuated cross-entropy.

Background, box, ball (red) and balloon (blue); a third of the balls and balloons are purple, and nothing in the image
tells which they are. The uncertainty should be high on them and at the outlines of objects. The attenuation h(raw) is
also a temperature, T = 1 / h(raw): softmax(logits / T) gives the class probabilities.
Run: python -m ajna.examples.segmentation --out out
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ajna.examples import scenes
from ajna.examples.harness import Batch, RgbImage, main
from ajna.losses import UncertaintyLoss

CLASSES = ("background", "box", "ball", "balloon")
_COLOURS = torch.tensor([[0.2, 0.2, 0.2], [0.9, 0.8, 0.2], [0.9, 0.2, 0.2], [0.2, 0.4, 0.95]])
_RED, _BLUE, _PURPLE = (0.85, 0.2, 0.2), (0.2, 0.3, 0.85), (0.6, 0.2, 0.6)
_AMBIGUOUS_SHARE = 1 / 3


class Segmentation:
    """Class per pixel; E[CE] in nats, h and g of the paper's Eq. 1."""

    name = "segmentation"
    unit = "nats"
    inputs, outputs = 3, len(CLASSES)
    height, width = 64, 80
    focal_px = 80.0
    options = scenes.SceneOptions(spheres=4, boxes=2)

    def __init__(self) -> None:
        self.loss = UncertaintyLoss("cross_entropy")

    def batch(self, count: int, generator: torch.Generator) -> Batch:
        world = scenes.random_scenes(count, generator, self.options)
        spheres = slice(2, 2 + self.options.spheres)
        balloon = torch.rand(count, self.options.spheres, generator=generator) < 0.5
        purple = torch.rand(count, self.options.spheres, generator=generator) < _AMBIGUOUS_SHARE
        colour = torch.where(balloon[..., None], torch.tensor(_BLUE), torch.tensor(_RED))
        world.colour[:, spheres] = torch.where(purple[..., None], torch.tensor(_PURPLE), colour)
        view = scenes.render(world, self.height, self.width, self.focal_px)

        label = torch.zeros(count, self.options.surfaces, dtype=torch.long)
        label[:, 2 + self.options.spheres :] = CLASSES.index("box")
        label[:, spheres] = torch.where(balloon, CLASSES.index("balloon"), CLASSES.index("ball"))
        unclear = torch.zeros(count, self.options.surfaces, dtype=torch.bool)
        unclear[:, spheres] = purple

        def seen(values: Tensor) -> Tensor:
            return values.gather(1, view.surface.flatten(1)).reshape(view.surface.shape)

        target, unclear = seen(label), seen(unclear)
        outline = scenes.object_boundary(target)
        calm = ~scenes.spread(outline, 3)
        regions = {
            "ambiguous appearance": (calm & unclear, calm & ~unclear),
            "object boundary": (outline & ~scenes.spread(unclear, 2), calm & ~unclear),
        }
        return Batch(view.image - 0.5, target, view.image, regions)

    def prediction(self, output: Tensor) -> Tensor:
        return output

    def baseline(self, batch: Batch) -> Tensor:
        share = torch.bincount(batch.target.flatten(), minlength=len(CLASSES)) / batch.target.numel()
        return -share.log()[batch.target]

    def rgb(self, prediction: Tensor, target: Tensor) -> tuple[RgbImage, RgbImage]:
        return _labels_to_image(prediction.argmax(0)), _labels_to_image(target[0])

    def probabilities(self, logits: Tensor, raw: Tensor) -> Tensor:
        """softmax(logits / T) with the temperature T = 1 / h(raw): [N, K, H, W], [N, 1, H, W] -> [N, K, H, W]."""
        return functional.softmax(logits * self.loss.attenuation(raw), dim=1)


def _labels_to_image(labels: Tensor) -> RgbImage:
    return np.rint(255 * _COLOURS[labels].numpy()).astype(np.uint8)


if __name__ == "__main__":
    sys.exit(main(Segmentation()))
