# SPDX-License-Identifier: MIT
"""A written file beside the network that it came from."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ajna.exports import FORMATS
from ajna.exports.runners import Array, Runner, open_exported
from ajna.nn import FlowNet, network_input

# (width, height) where a format takes any: multiples of the stride and others.
_ANY_SIZES = ((64, 48), (57, 33), (32, 80))
_SEED = 20231
_SCENES = 2


@dataclass(frozen=True)
class Difference:
    """Largest absolute differences over all checked inputs; those in pixels also as a mean."""

    raw: float  # of the network's four output channels, in its own unit
    flow_px: float
    flow_mean_px: float
    uncertainty: float
    expected_error_px: float
    share: float  # of `raw` in the largest raw value: what the format's limit is about
    checked: tuple[str, ...]  # WIDTHxHEIGHT, with the batch where it is not 1


def verify(
    path: Path, net: FlowNet, metadata: Mapping[str, Any], file_format: str, width: int, height: int
) -> Difference:
    """Run the file on rendered scenes and on noise, and compare raw output and maps with those of ``net``.

    Raises:
        ValueError: it differs by more than the format's limit, or gives NaN.
    """
    kind = FORMATS[file_format]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch plans to retire TorchScript
        runner = open_exported(file_format, path)
    sizes = ((width, height),) if kind.fixed_size else _ANY_SIZES
    pairs = [(size, pair) for size in sizes for pair in _pairs(*size, kind.on_noise)]
    worst = {"raw": 0.0, "flow": 0.0, "mean": 0.0, "uncertainty": 0.0, "error": 0.0, "share": 0.0}
    checked: list[str] = []
    batches: dict[tuple[int, int], list[Array]] = {}
    for size, (frame1, frame2) in pairs:
        frames = [torch.from_numpy(frame).permute(2, 0, 1)[None] for frame in (frame1, frame2)]
        x = network_input(frames[0], frames[1])
        expected = _maps(net, metadata, x)
        given = (runner.raw(x.numpy()), *runner.predict(frame1, frame2))
        _compare(expected, given, worst)
        batches.setdefault(size, []).append(x.numpy())
        checked.append(f"{size[0]}x{size[1]}")
    if kind.any_batch:
        for size, inputs in batches.items():
            _compare_batch(np.concatenate(inputs), net, runner, worst)
            checked.append(f"{len(inputs)}x{size[0]}x{size[1]}")
    if not worst["share"] <= kind.limit:  # so that NaN fails, too
        raise ValueError(
            f"the {kind.label} file differs from the network by {worst['raw']:.3g}, which is "
            f"{worst['share']:.2g} of the largest raw value and more than the limit of {kind.limit:g}: it is not kept; "
            + ("give more and better calibration frames" if "int8" in file_format else "please report the versions")
        )
    return Difference(
        worst["raw"],
        worst["flow"],
        worst["mean"],
        worst["uncertainty"],
        worst["error"],
        worst["share"],
        tuple(dict.fromkeys(checked)),
    )


def _pairs(width: int, height: int, with_noise: bool) -> list[tuple[Array, Array]]:
    """Rendered scenes, and noise: what the network was made for and what it was not."""
    from ajna.data.synthetic import SyntheticScenes

    scenes = SyntheticScenes(_SCENES, width, height, seed=_SEED, scene={"bank_size": 12})  # quick
    pairs = [(pair.frame1, pair.frame2) for pair in map(scenes.read, range(_SCENES))]
    if not with_noise:
        return pairs
    random = np.random.default_rng(_SEED)
    noise = random.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    return [*pairs, (noise[0], noise[1])]


def _maps(net: FlowNet, metadata: Mapping[str, Any], x: torch.Tensor) -> tuple[Array, ...]:
    scale = float(metadata["flow_scale"])
    with torch.no_grad():
        raw = net(x)
        uncertainty, error = metadata["table"].evaluate(raw[:, 2:4])
    return raw.numpy(), (raw[:, :2] * scale).numpy(), uncertainty.numpy(), (error * scale).numpy()


def _compare(expected: tuple[Array, ...], given: tuple[Array, ...], worst: dict[str, float]) -> None:
    for name, mine, theirs in zip(("raw", "flow", "uncertainty", "error"), expected, given, strict=True):
        if mine.shape != theirs.shape:
            raise ValueError(f"the exported file gives {name} of shape {theirs.shape}, not {mine.shape}")
        worst[name] = _larger(worst[name], float(np.abs(mine - theirs).max()))
    difference, scale = float(np.abs(expected[0] - given[0]).max()), float(np.abs(expected[0]).max())
    worst["share"] = _larger(worst["share"], difference / max(scale, 1e-12))
    length = np.hypot(*(np.moveaxis(expected[1] - given[1], 1, 0)))
    worst["mean"] = _larger(worst["mean"], float(length.mean()))


def _compare_batch(x: Array, net: FlowNet, runner: Runner, worst: dict[str, float]) -> None:
    with torch.no_grad():
        expected = net(torch.from_numpy(x)).numpy()
    difference = float(np.abs(expected - runner.raw(x)).max())
    worst["raw"] = _larger(worst["raw"], difference)
    worst["share"] = _larger(worst["share"], difference / max(float(np.abs(expected).max()), 1e-12))


def _larger(a: float, b: float) -> float:
    """NaN wins, unlike in max()."""
    return a if a >= b or a != a else b
