# SPDX-License-Identifier: MIT
"""A plain small network: nothing in it knows of uncertainty, which is a few more output channels."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


def _block(inputs: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        layers += [nn.Conv2d(channels, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Three levels with skip connections (Ronneberger et al., 2015): [N, inputs, H, W] -> [N, outputs, H, W].

    H and W must be multiples of 4.
    """

    def __init__(self, inputs: int, outputs: int, width: int = 8) -> None:
        super().__init__()
        self.down = nn.ModuleList([_block(inputs, width), _block(width, 2 * width), _block(2 * width, 4 * width)])
        self.up = nn.ModuleList([_block(6 * width, 2 * width), _block(3 * width, width)])
        self.head = nn.Conv2d(width, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.down[0](x)
        middle = self.down[1](functional.max_pool2d(fine, 2))
        out = self.down[2](functional.max_pool2d(middle, 2))
        for block, skip in zip(self.up, (middle, fine), strict=True):
            out = functional.interpolate(out, scale_factor=2, mode="bilinear", align_corners=False)
            out = block(torch.cat([out, skip], 1))
        return self.head(out)
