# SPDX-License-Identifier: MIT
"""Surface normals: one shaded image in, unit vectors out, by the angular loss.

The uncertainty should be high at creases, where the normal turns, and at the outlines of objects.
Run: python -m ajna.examples.normals --out out
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ajna.examples import scenes
from ajna.examples.harness import Batch, RgbImage, main
from ajna.losses import preset


class Normals:
    """Normals from shading, by the angular von Mises-Fisher loss of Bae et al., 2021 (Table 3)."""

    name = "normals"
    unit = "rad"
    inputs, outputs = 3, 3
    height, width = 64, 80
    focal_px = 80.0
    options = scenes.SceneOptions(texture=0.1, light_spread=0.1)

    def __init__(self) -> None:
        self.loss = preset("bae2021")

    def batch(self, count: int, generator: torch.Generator) -> Batch:
        view = scenes.render(
            scenes.random_scenes(count, generator, self.options), self.height, self.width, self.focal_px
        )
        outline = scenes.object_boundary(view.surface)
        # An edge inside of a box, where two of its faces meet.
        crease = scenes.crease(view.normal) & ~scenes.spread(outline, 2)
        calm = ~scenes.spread(outline | scenes.crease(view.normal), 3)
        regions = {"crease": (crease, calm), "object boundary": (outline, calm)}
        return Batch(view.image - 0.5, view.normal, view.image, regions)

    def prediction(self, output: Tensor) -> Tensor:
        return functional.normalize(output + torch.tensor([0.0, -0.5, -1.0])[:, None, None], dim=1)

    def baseline(self, batch: Batch) -> Tensor:
        mean = functional.normalize(batch.target.mean((0, 2, 3)), dim=0)
        return self.loss.error(mean[None, :, None, None].expand_as(batch.target), batch.target)

    def rgb(self, prediction: Tensor, target: Tensor) -> tuple[RgbImage, RgbImage]:
        return _normal_to_image(prediction), _normal_to_image(target)


def _normal_to_image(normal: Tensor) -> RgbImage:
    """[3, H, W] -> RGB: right is red, up is green, towards the camera is blue."""
    turned = normal * torch.tensor([1.0, -1.0, -1.0])[:, None, None]
    return np.rint(127.5 * (turned.permute(1, 2, 0).numpy() + 1.0)).astype(np.uint8)


if __name__ == "__main__":
    sys.exit(main(Normals()))
