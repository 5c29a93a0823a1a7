# SPDX-License-Identifier: MIT
"""Monocular depth: one image in, metres out. The uncertainty should be high where the depth jumps.

Run: python -m ajna.examples.depth --out out
"""

from __future__ import annotations

import sys

import matplotlib
import numpy as np
import torch
from torch import Tensor

from ajna.examples import scenes
from ajna.examples.harness import Batch, RgbImage, main
from ajna.losses import UncertaintyLoss


class Depth:
    """Depth from shading, texture and size, by the paper's own loss (Eq. 1)."""

    name = "depth"
    unit = "m"
    inputs, outputs = 3, 1
    height, width = 64, 80
    focal_px = 80.0

    def __init__(self) -> None:
        self.loss = UncertaintyLoss()

    def batch(self, count: int, generator: torch.Generator) -> Batch:
        view = scenes.render(scenes.random_scenes(count, generator), self.height, self.width, self.focal_px)
        jump = scenes.depth_boundary(view.depth)
        regions = {"depth boundary": (jump, ~scenes.spread(jump, 4))}
        return Batch(view.image - 0.5, view.depth, view.image, regions)

    def prediction(self, output: Tensor) -> Tensor:
        return output + 4.0  # metres: the middle of the scenes

    def baseline(self, batch: Batch) -> Tensor:
        return (batch.target - batch.target.median()).abs()

    def rgb(self, prediction: Tensor, target: Tensor) -> tuple[RgbImage, RgbImage]:
        near, far = float(target.min()), float(target.max())
        return depth_to_image(prediction, near, far), depth_to_image(target, near, far)


def depth_to_image(values: Tensor, low: float, high: float) -> RgbImage:
    """[1, H, W] -> RGB: bright is low, dark is high."""
    scaled = ((values[0].double() - low) / (high - low)).clamp(0.0, 1.0).numpy()
    rgba: RgbImage = matplotlib.colormaps["viridis_r"](scaled, bytes=True)
    return np.ascontiguousarray(rgba[..., :3])


if __name__ == "__main__":
    sys.exit(main(Depth()))
