# SPDX-License-Identifier: MIT
"""What helps the network off its first plateau, where it predicts zero flow everywhere.

From a random start, motion is a second-order effect in the activations, which the brightness of the frames dominates;
gradients through the whole encoder-decoder are then mostly noise. Two aids, both for training only, change that: the
first convolution begins as motion-energy filters (Adelson and Bergen, 1985), and linear heads on inner layers predict
coarse flow. Neither changes the network's shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ajna.nn import FlowNet

_WAVELENGTHS_PX = (4.5, 9.0)
_DIRECTIONS = 8
_PHASES = (0.0, math.pi / 2)
_NOISE = 0.15  # random share of each filter, so that equal filters part


@torch.no_grad()
def start_with_motion_energy(net: FlowNet) -> None:
    """Set the first convolution to quadrature pairs of oriented waves, a quarter wave apart between the frames.

    Each filter answers to motion along its direction more than against it. Filters cycle through 8 directions, 2 phases
    and 2 wavelengths; they have no response to uniform brightness and keep the norm that random filters have.

    Raises:
        ValueError: the network does not take two frames of equal channel count.
    """
    weight = dict(net.named_parameters())["encoder.0.conv.weight"]
    count, channels, size, _ = weight.shape
    if channels % 2:
        raise ValueError(f"network with {channels} input channels: motion-energy filters need two frames of equal ones")
    axis = torch.arange(size) - (size - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    window = torch.exp(-(x.square() + y.square()) / (2 * 2.0**2))
    filters = torch.empty_like(weight)
    for index in range(count):
        direction = math.tau * (index % _DIRECTIONS) / _DIRECTIONS
        phase = _PHASES[index // _DIRECTIONS % len(_PHASES)]
        wavelength = _WAVELENGTHS_PX[index // (_DIRECTIONS * len(_PHASES)) % len(_WAVELENGTHS_PX)]
        along = math.tau / wavelength * (x * math.cos(direction) + y * math.sin(direction))
        for frame, shift in enumerate((0.0, -math.pi / 2)):
            wave = window * torch.cos(along + phase + shift)
            wave = wave - window * (wave.sum() / window.sum())
            filters[index, frame * channels // 2 : (frame + 1) * channels // 2] = wave
    filters += _NOISE * filters.std() * torch.randn_like(filters)
    norm = weight.flatten(1).norm(dim=1).mean()
    weight.copy_(filters / filters.flatten(1).norm(dim=1)[:, None, None, None] * norm)


class FlowHeads(nn.Module):
    """3x3 convolutions from inner layers to flow at their resolution, for an auxiliary L1 loss.

    Heads sit on the residual blocks of encoder and decoder. ``activations`` are those of ``FlowNet.forward_layers``.
    """

    def __init__(self, net: FlowNet) -> None:
        super().__init__()
        side = 2 * net.config.stride
        training = net.training
        with torch.no_grad():
            layers = net.eval().forward_layers(torch.zeros(1, net.config.in_channels, side, side))
        net.train(training)
        # Layers 2, 4, ... of the encoder and 0, 2, ... of the decoder are the residual blocks.
        self.places = [2 + 2 * i for i in range(2 * net.config.sub_blocks)]
        self.heads = nn.ModuleList(nn.Conv2d(layers[i].shape[1], 2, 3, padding=1) for i in self.places)

    def loss(self, activations: list[Tensor], target: Tensor, valid: Tensor | None = None) -> Tensor:
        """Sum over heads of the mean absolute error against ``target`` [N, 2, H, W] averaged to their size.

        With ``valid`` bool [N, 1, H, W] only such pixels are averaged, and each average counts by their share.
        """
        total = target.new_zeros(())
        for place, head in zip(self.places, self.heads, strict=True):
            coarse = head(activations[place]).float()
            mean, share = averaged(target, valid, coarse.shape[-2:])
            if share is None:
                total = total + (coarse - mean).abs().mean()
            else:
                total = total + ((coarse - mean).abs() * share).sum() / (2 * share.sum()).clamp_min(1e-6)
        return total


def averaged(target: Tensor, valid: Tensor | None, size: Sequence[int]) -> tuple[Tensor, Tensor | None]:
    """``target`` [N, C, H, W] averaged to ``size`` (h, w) over its valid pixels, and their share [N, 1, h, w].

    ``valid`` is bool [N, 1, H, W]; without it the share is None, for all. Where no pixel is valid the average is 0.
    """
    pool = nn.AdaptiveAvgPool2d(tuple(size))
    if valid is None:
        return pool(target), None
    share = pool(valid.to(target.dtype))
    return pool(torch.where(valid, target, 0.0)) / share.clamp_min(1e-6), share
