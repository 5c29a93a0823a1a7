# SPDX-License-Identifier: MIT
"""Stereo disparity: two rectified images in, pixels out, D = b f / Z (paper Eq. 23).

The uncertainty should be high where the right camera does not see what the left one does, at depth boundaries, and on
surfaces without a pattern. Run: python -m ajna.examples.disparity --out out
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor
from torch.nn import functional

from ajna.examples import scenes
from ajna.examples.depth import depth_to_image
from ajna.examples.harness import Batch, RgbImage, main
from ajna.losses import preset

_CANDIDATES = 20  # disparities that the network is shown the difference of the images at: 0 to 19 px


class Disparity:
    """Disparity of a stereo pair, by the loss of Yuan et al., 2021 (Table 3)."""

    name = "disparity"
    unit = "px"
    inputs, outputs = 3 + _CANDIDATES, _CANDIDATES
    height, width = 64, 80
    focal_px, base_m = 80.0, 0.4
    options = scenes.SceneOptions(texture=0.6, frequency=15.0, plain_share=0.4, floor_spread=0.3)

    def __init__(self) -> None:
        self.loss = preset("yuan2021")

    def batch(self, count: int, generator: torch.Generator) -> Batch:
        world = scenes.random_scenes(count, generator, self.options)
        left = scenes.render(world, self.height, self.width, self.focal_px)
        right = scenes.render(world, self.height, self.width, self.focal_px, shift_m=self.base_m)
        disparity = self.base_m * self.focal_px / left.depth  # Eq. 23
        hidden = self.hidden(left, right, disparity)
        edge = scenes.depth_boundary(left.depth)
        pattern = world.contrast.gather(1, left.surface.flatten(1)).reshape(left.surface.shape) > 0
        calm = ~scenes.spread(edge | hidden | scenes.object_boundary(left.surface), 3)
        regions = {
            "hidden from the right camera": (hidden, calm & pattern),
            "depth boundary": (edge, calm & pattern),
            "no pattern": (calm & ~pattern, calm & pattern),
        }
        noisy = [
            (view.image + 0.01 * torch.randn(view.image.shape, generator=generator)).clamp(0, 1)
            for view in (left, right)
        ]
        return Batch(self.network_input(*noisy), disparity, left.image, regions)

    def network_input(self, left: Tensor, right: Tensor) -> Tensor:
        """The left image, and its difference from the right one at every candidate disparity."""
        costs = []
        for shift in range(_CANDIDATES):
            moved = functional.pad(right, (shift, 0, 0, 0))[..., : right.shape[-1]]
            costs.append((left - moved).abs().mean(1, keepdim=True))
        return torch.cat([left - 0.5, *(4.0 * cost for cost in costs)], 1)

    def hidden(self, left: scenes.View, right: scenes.View, disparity: Tensor) -> Tensor:
        """Pixels of the left image whose surface point the right camera does not see, bool [N, 1, H, W]."""
        columns = torch.arange(self.width) - disparity
        grid_x = columns.round().long()
        inside = (grid_x >= 0) & (grid_x < self.width)
        seen = right.depth.gather(3, grid_x.clamp(0, self.width - 1))
        return ~inside | (seen < 0.93 * left.depth)

    def prediction(self, output: Tensor) -> Tensor:
        # The mean over the candidates, which the network gives a score each (Kendall et al., 2017: GC-Net).
        return (output.softmax(1) * torch.arange(_CANDIDATES)[:, None, None]).sum(1, keepdim=True)

    def baseline(self, batch: Batch) -> Tensor:
        return (batch.target - batch.target.median()).abs()

    def rgb(self, prediction: Tensor, target: Tensor) -> tuple[RgbImage, RgbImage]:
        low, high = float(target.min()), float(target.max())
        # Near is bright, as for depth.
        return depth_to_image(-prediction, -high, -low), depth_to_image(-target, -high, -low)


if __name__ == "__main__":
    sys.exit(main(Disparity()))
