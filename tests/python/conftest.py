# SPDX-License-Identifier: MIT
"""Fixtures that several test files share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

FRAME_SHIFT = (3, -2)  # px, (u, v) of `frame_pair`


def smooth_texture(height: int, width: int, seed: int) -> NDArray[np.uint8]:
    """Random RGB uint8 [H, W, 3] without frequencies near the pixel grid's limit; wraps around at its borders."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(height, width, 3)), axes=(0, 1))
    fy, fx = np.fft.fftfreq(height)[:, None, None], np.fft.rfftfreq(width)[None, :, None]
    image = np.fft.irfft2(spectrum * np.exp(-(fx**2 + fy**2) / (2 * 0.06**2)), s=(height, width), axes=(0, 1))
    low, high = image.min(), image.max()
    return np.rint(255 * (image - low) / (high - low)).astype(np.uint8)


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Small trainings on one thread: two that wait for each other on a busy machine are several times slower."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def frame_pair() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two RGB frames uint8 [48, 64, 3]; everything moves by FRAME_SHIFT from the first to the second."""
    first = smooth_texture(48, 64, seed=1)
    u, v = FRAME_SHIFT
    return first, np.roll(first, (v, u), axis=(0, 1))


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a network of width 4 with random weights."""
    from ajna import nn
    from ajna.losses import UncertaintyLoss

    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    provenance = {"data": "none", "steps": 0}
    nn.save_checkpoint(
        path, nn.FlowNet(width=4), name="tiny", loss=UncertaintyLoss(), flow_scale=2.0, provenance=provenance
    )
    return path


@pytest.fixture(scope="session")
def flight_checkpoint(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`tiny_checkpoint` with larger weights, so that it passes the flight program's self-test."""
    from ajna import nn
    from ajna.losses import UncertaintyLoss

    path = tmp_path_factory.mktemp("flight") / "tiny.safetensors"
    net, metadata = nn.load_checkpoint(tiny_checkpoint)
    with torch.no_grad():  # untrained weights hardly look at the frames
        for parameter in net.parameters():
            parameter *= 2.5 if parameter.dim() > 1 else 1.0
    nn.save_checkpoint(path, net, "tiny", UncertaintyLoss(), metadata["flow_scale"])
    return path


@pytest.fixture(scope="session")
def flight_script(flight_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`flight_checkpoint` as a TorchScript file."""
    from ajna import nn

    path = tmp_path_factory.mktemp("script") / "tiny.pt"
    nn.export_torchscript(path, *nn.load_checkpoint(flight_checkpoint))
    return path


@pytest.fixture(scope="session")
def member_runs(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three runs, each with a model.safetensors: `tiny_checkpoint` with its weights a little off."""
    from ajna import nn
    from ajna.losses import UncertaintyLoss

    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        net, metadata = nn.load_checkpoint(tiny_checkpoint)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in net.parameters():
                parameter += 0.05 * parameter.abs().mean() * torch.randn(parameter.shape, generator=generator)
        path = folder / f"member{seed}" / "model.safetensors"
        path.parent.mkdir()
        nn.save_checkpoint(path, net, path.parent.name, UncertaintyLoss(), metadata["flow_scale"])
    return folder
