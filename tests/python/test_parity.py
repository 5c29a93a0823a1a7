# SPDX-License-Identifier: MIT
"""The C++ engine, the Python module and TorchScript give the same numbers on the same pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import ajna
from ajna import nn
from ajna.losses import UncertaintyLoss

NAMES = ("flow", "uncertainty", "expected_error")
Planes = dict[str, NDArray[np.float32]]


def to_batch(frame: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(frame).permute(2, 0, 1)[None].contiguous()


def to_planes(tensors: tuple[torch.Tensor, ...]) -> Planes:
    return {name: tensor[0].permute(1, 2, 0).numpy() for name, tensor in zip(NAMES, tensors, strict=True)}


def by_engine(path: Path, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8]) -> Planes:
    field = ajna.load(path)(frame1, frame2)
    return {name: getattr(field, name) for name in NAMES}


def by_module(path: Path, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8]) -> Planes:
    net, metadata = nn.load_checkpoint(path)
    with torch.no_grad():
        output = net(nn.network_input(to_batch(frame1), to_batch(frame2)))
        uncertainty, error = metadata["table"].evaluate(output[:, 2:4])
    scale = metadata["flow_scale"]
    return to_planes((output[:, :2] * scale, uncertainty, error * scale))


def by_script(path: Path, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8]) -> Planes:
    with torch.no_grad():
        return to_planes(torch.jit.load(path).predict(to_batch(frame1), to_batch(frame2)))


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every shipped model, and the paper's network with random weights and statistics."""
    torch.manual_seed(3)
    net = nn.FlowNet()
    with torch.no_grad():
        for name, tensor in (*net.named_parameters(), *net.named_buffers()):
            if "norm" in name and tensor.is_floating_point():
                tensor.copy_(torch.rand_like(tensor) + 0.5)
    path = tmp_path_factory.mktemp("parity") / "random.safetensors"
    nn.save_checkpoint(path, net, name="random", loss=UncertaintyLoss(), flow_scale=20.0)
    return {"random": path, **{file.stem: file for file in ajna.models().values()}}


@pytest.mark.parametrize("size", [(240, 320), (75, 101)], ids=lambda size: f"{size[1]}x{size[0]}")
def test_three_ways_one_result(
    checkpoints: dict[str, Path], size: tuple[int, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generator = np.random.default_rng(0)
    frame1 = generator.integers(0, 256, (*size, 3), dtype=np.uint8)
    frame2 = np.roll(frame1, (2, 5), axis=(0, 1))
    for model_name, path in checkpoints.items():
        script = tmp_path / f"{model_name}.pt"
        net, metadata = nn.load_checkpoint(path)
        nn.export_torchscript(script, net, metadata)
        module = by_module(path, frame1, frame2)
        others = {
            "engine": by_engine(path, frame1, frame2),
            "TorchScript": by_script(script, frame1, frame2),
            "engine on TorchScript": by_engine(script, frame1, frame2),
        }
        for way, planes in others.items():
            differences = {name: float(np.abs(planes[name] - module[name]).max()) for name in NAMES}
            text = ", ".join(f"{name} {value:.2g}" for name, value in differences.items())
            with capsys.disabled():
                print(f"\n  {model_name} {size[1]}x{size[0]}: |{way} - module| max: {text}", end="")
            for name in NAMES:
                assert planes[name].dtype == np.float32
                scale = float(np.abs(module[name]).max())
                assert differences[name] <= 1e-4 * scale, f"{name} of {way} (largest value {scale})"
