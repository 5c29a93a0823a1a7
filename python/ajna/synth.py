# SPDX-License-Identifier: MIT
"""Synthetic frame pairs with exact flow, occlusion and motion boundaries (the C++ library ``synth``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ajna import _core
from ajna._core import PairBatch, SceneConfig

__all__ = ["PairBatch", "PairGenerator", "SceneConfig", "load_photos", "scene_config", "scene_options"]

_PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".ppm"}


def scene_options() -> dict[str, Any]:
    """All scene options with their defaults, read from the C++ ``SceneConfig``."""
    defaults = SceneConfig()
    names = [name for name, value in vars(SceneConfig).items() if isinstance(value, property)]
    return {name: getattr(defaults, name) for name in names}


def scene_config(options: Mapping[str, Any] | None = None) -> SceneConfig:
    """A ``SceneConfig`` from a mapping of options, as it stands in a training config.

    Raises:
        ValueError: an option is unknown (the nearest known one is named), of the wrong type, or out of range.
    """
    known = scene_options()
    config = SceneConfig()
    for name, value in (options or {}).items():
        if name not in known:
            near = _core.nearest_name(name, list(known))
            hint = f", did you mean '{near}'?" if near else ""
            raise ValueError(f"unknown scene option '{name}'{hint} Known: {', '.join(sorted(known))}")
        try:
            setattr(config, name, value)
        except TypeError:
            expected = type(known[name]).__name__
            raise ValueError(f"scene option '{name}' = {value!r}: give a value of type {expected}") from None
    _core.validate_scene_config(config)
    return config


class PairGenerator:
    """Makes batches of synthetic frame pairs.

    Args:
        config: scene options, or ``None`` for the defaults.
        bank_seed: seed of the procedural texture bank.
        device: where scenes are made and returned, for example ``"cpu"`` or ``"cuda"``.
        photos: optional photograph crops, uint8 ``[N, 3, texture_size, texture_size]`` (see :func:`load_photos`).

    Equal config, seeds and shapes give equal bits on a CPU.
    """

    def __init__(
        self,
        config: SceneConfig | Mapping[str, Any] | None = None,
        bank_seed: int = 0,
        device: str | torch.device = "cpu",
        photos: torch.Tensor | None = None,
    ) -> None:
        scene = config if isinstance(config, SceneConfig) else scene_config(config)
        self._core = _core.PairGenerator(scene, bank_seed, str(device), photos)

    def __call__(self, batch: int, height: int, width: int, seed: int, flow_scale: float = 1.0) -> PairBatch:
        """``batch`` pairs of ``height`` x ``width`` pixels; the GIL is released.

        Returns a ``PairBatch``: ``frame1``, ``frame2`` uint8 [B, 3, H, W] RGB; ``flow`` float32 [B, 2, H, W] in pixels
        (frame1(x) ~ frame2(x + flow(x))); ``occlusion``, ``motion_boundary`` bool [B, 1, H, W]; ``layer1``, ``layer2``
        uint8 [B, 1, H, W]. ``flow_scale`` multiplies the configured displacements.

        Raises:
            ValueError: a size below 1 or an impossible scale.
        """
        return self._core.generate(batch, height, width, seed, flow_scale)

    @property
    def config(self) -> SceneConfig:
        """The scene options in use."""
        return self._core.config

    @property
    def textures(self) -> torch.Tensor:
        """The texture bank, float32 [N, 3, S, S] in [0, 1]."""
        return self._core.textures


def load_photos(folder: str | Path, count: int, size: int, seed: int = 0) -> torch.Tensor:
    """Random square crops of the photographs in ``folder``, resized to ``size``: uint8 ``[count, 3, size, size]``.

    Each crop covers 35 to 100 % of the photograph's shorter side; photographs are taken in turn.

    Raises:
        FileNotFoundError: the folder does not exist.
        ValueError: it holds no photographs, or one of them cannot be read (named).
    """
    from PIL import Image, UnidentifiedImageError

    root = Path(folder)
    if not root.is_dir():
        raise FileNotFoundError(f"photograph folder '{root}' does not exist: give a folder of .jpg or .png files")
    files = sorted(f for f in root.iterdir() if f.suffix.lower() in _PHOTO_SUFFIXES)
    if not files:
        raise ValueError(f"photograph folder '{root}' holds no .jpg, .png, .bmp or .ppm file: give another folder")
    random = np.random.default_rng(seed)
    crops = torch.empty((count, 3, size, size), dtype=torch.uint8)
    for i in range(count):
        file = files[i % len(files)]
        try:
            with Image.open(file) as opened:
                picture = opened.convert("RGB")
        except (UnidentifiedImageError, OSError) as error:
            raise ValueError(f"photograph '{file}' cannot be read ({error}): remove or replace it") from None
        side = int(random.uniform(0.35, 1.0) * min(picture.size))
        side = max(side, 1)
        left = int(random.integers(0, picture.width - side + 1))
        top = int(random.integers(0, picture.height - side + 1))
        crop = picture.resize((size, size), Image.Resampling.LANCZOS, box=(left, top, left + side, top + side))
        crops[i] = torch.from_numpy(np.asarray(crop).copy()).permute(2, 0, 1)
    return crops
