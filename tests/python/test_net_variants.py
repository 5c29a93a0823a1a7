# SPDX-License-Identifier: MIT
"""Skip connections, heads at several scales and the correlation volume, from Python."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import pytest
import torch

from ajna import nn
from ajna.losses import UncertaintyLoss

VARIANTS = [
    {"skip_connections": True},
    {"scale_heads": True},
    {"correlation_radius": 2},
    {"skip_connections": True, "scale_heads": True, "correlation_radius": 1},
]


@pytest.mark.parametrize("options", VARIANTS, ids=str)
def test_a_variant_is_a_module_that_saves_copies_and_loads(options: dict, tmp_path: Path) -> None:
    net = nn.FlowNet(width=8, **options).eval()
    x = torch.rand(1, 6, 50, 37)
    expected = net(x)
    for clone in (copy.deepcopy(net), pickle.loads(pickle.dumps(net))):
        assert clone.config == net.config
        assert torch.equal(clone(x), expected)
    path = tmp_path / "net.safetensors"
    nn.save_checkpoint(path, net, "variant", UncertaintyLoss())
    loaded, _ = nn.load_checkpoint(path)
    assert loaded.config == net.config
    assert torch.equal(loaded(x), expected)
    for name, value in options.items():
        assert f"{name}={int(value)}" in repr(loaded)


def test_scales_train_every_parameter() -> None:
    net = nn.FlowNet(width=8, skip_connections=True, scale_heads=True, correlation_radius=1)
    scales = net.forward_scales(torch.rand(2, 6, 32, 48))
    assert [tuple(scale.shape[2:]) for scale in scales] == [(8, 12), (16, 24), (32, 48)]
    loss = UncertaintyLoss()([s[:, :2] for s in scales], [s[:, 2:] for s in scales], torch.rand(2, 2, 32, 48))
    loss.backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


def test_an_impossible_variant_is_named() -> None:
    with pytest.raises(ValueError, match="correlation_radius = 9"):
        nn.FlowNet(correlation_radius=9)
    with pytest.raises(ValueError, match="correlation_radius = 1"):
        nn.FlowNet(correlation_radius=1, sub_blocks=0)
