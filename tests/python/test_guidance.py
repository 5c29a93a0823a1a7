# SPDX-License-Identifier: MIT
"""The aids for the start: filters that tell directions of motion apart, and heads that learn coarse flow."""

from __future__ import annotations

import math

import pytest
import torch

from ajna.nn import FlowNet
from ajna.training.guidance import FlowHeads, start_with_motion_energy


def moving_wave(direction: float, speed: float) -> torch.Tensor:
    """[1, 6, 48, 48]: a grating of wavelength 9 px that moves by ``speed`` px along ``direction``."""
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
    along = x * math.cos(direction) + y * math.sin(direction)
    frames = [torch.cos(math.tau / 9.0 * (along - shift)) for shift in (0.0, speed)]
    return torch.stack([frame for frame in frames for _ in range(3)])[None]


def test_first_layer_answers_to_motion_along_its_direction() -> None:
    torch.manual_seed(0)
    net = FlowNet()
    before = dict(net.named_parameters())["encoder.0.conv.weight"].detach().clone()
    start_with_motion_energy(net)
    weight = dict(net.named_parameters())["encoder.0.conv.weight"].detach()
    assert torch.allclose(weight.flatten(1).norm(dim=1).mean(), before.flatten(1).norm(dim=1).mean(), rtol=1e-4)
    for index in range(16, 24):  # one phase of each direction at the longer wavelength
        direction = math.tau * (index % 8) / 8
        energy = []
        for speed in (2.25, -2.25):
            answer = torch.nn.functional.conv2d(moving_wave(direction, speed), weight[index : index + 1])
            energy.append(float(answer.square().mean()))
        assert energy[0] > 1.5 * energy[1]


def test_filters_do_not_answer_to_uniform_brightness_much() -> None:
    torch.manual_seed(0)
    net = FlowNet(width=16)
    start_with_motion_energy(net)
    weight = dict(net.named_parameters())["encoder.0.conv.weight"].detach()
    # Only the random share of each filter has a mean.
    assert float(weight.flatten(1).sum(1).abs().max() / weight.flatten(1).abs().sum(1).max()) < 0.2


def test_odd_channel_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="two frames"):
        start_with_motion_energy(FlowNet(in_channels=3))


@pytest.mark.parametrize("sub_blocks", [1, 2])
def test_heads_learn_and_reach_the_encoder(sub_blocks: int) -> None:
    torch.manual_seed(0)
    net = FlowNet(width=8, sub_blocks=sub_blocks)
    heads = FlowHeads(net)
    assert net.training
    x, target = torch.randn(2, 6, 64, 64), torch.ones(2, 2, 64, 64) * torch.tensor([0.5, -1.0]).view(1, 2, 1, 1)
    optimizer = torch.optim.Adam([*net.parameters(), *heads.parameters()], 1e-2)
    losses = []
    for _ in range(30):
        loss = heads.loss(net.forward_layers(x), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    assert dict(net.named_parameters())["encoder.0.conv.weight"].grad is not None


def test_layers_end_with_the_output() -> None:
    net = FlowNet(width=8).eval()
    x = torch.randn(1, 6, 32, 48)
    with torch.no_grad():
        layers = net.forward_layers(x)
        assert torch.equal(layers[-1], net(x))
    assert [tuple(layer.shape[2:]) for layer in layers[:3]] == [(16, 24), (8, 12), (8, 12)]
