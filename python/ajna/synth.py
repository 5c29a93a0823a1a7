# SPDX-License-Identifier: MIT
"""Synthetic frame pairs with exact flow, occlusion and motion boundaries, and augmentation (C++ library ``synth``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from ajna import _core
from ajna._core import AugmentConfig, PairBatch, SceneConfig

__all__ = [
    "AugmentConfig",
    "Augmenter",
    "PairBatch",
    "PairGenerator",
    "SceneConfig",
    "augment_config",
    "augment_options",
    "load_photos",
    "presets",
    "scene_config",
    "scene_options",
]

_PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".ppm"}

_Options = TypeVar("_Options", SceneConfig, AugmentConfig)


def scene_options() -> dict[str, Any]:
    """All scene options with their defaults, read from the C++ ``SceneConfig``."""
    return _values(SceneConfig())


def augment_options() -> dict[str, Any]:
    """All augmentation options with their defaults, read from the C++ ``AugmentConfig``."""
    return _values(AugmentConfig())


def presets() -> dict[str, str]:
    """Names of the scene presets and what is seen in them; the first, ``general``, has the defaults."""
    return {preset.name: preset.summary for preset in _core.scene_presets()}


def scene_config(options: Mapping[str, Any] | None = None) -> SceneConfig:
    """A ``SceneConfig`` from a mapping of options, as it stands in a training config.

    ``preset`` names the scenes to start from (see :func:`presets`); the options beside it replace the preset's.

    Raises:
        ValueError: a preset or an option is unknown (the nearest known one is named), of the wrong type, or out of
            range.
    """
    changes = dict(options or {})
    preset = changes.pop("preset", None)
    config = SceneConfig() if preset is None else SceneConfig(_core.scene_preset(_name("scene", preset)).config)
    _apply(config, changes, "scene")
    _core.validate_scene_config(config)
    return config


def augment_config(options: Mapping[str, Any] | None = None) -> AugmentConfig:
    """An ``AugmentConfig`` from a mapping of options; ``preset`` may be ``standard``, ``authors`` or ``none``.

    Raises:
        ValueError: a preset or an option is unknown (the nearest known one is named), of the wrong type, or out of
            range.
    """
    changes = dict(options or {})
    preset = changes.pop("preset", None)
    start = AugmentConfig() if preset is None else _core.augment_preset(_name("augmentation", preset)).config
    config = AugmentConfig(start)
    _apply(config, changes, "augmentation")
    return _core.Augmenter(config).config


def _values(config: SceneConfig | AugmentConfig) -> dict[str, Any]:
    names = [name for name, value in vars(type(config)).items() if isinstance(value, property)]
    return {name: getattr(config, name) for name in names}


def _name(kind: str, preset: object) -> str:
    if not isinstance(preset, str):
        raise ValueError(f"{kind} option 'preset' = {preset!r}: give a preset's name")
    return preset


def _apply(config: _Options, options: Mapping[str, Any], kind: str) -> None:
    """Set ``options`` on ``config``; unknown names and wrong types are refused."""
    known = _values(config)
    for name, value in options.items():
        if name not in known:
            near = _core.nearest_name(name, list(known))
            hint = f", did you mean '{near}'?" if near else ""
            raise ValueError(f"unknown {kind} option '{name}'{hint} Known: {', '.join(sorted(known))}")
        try:
            setattr(config, name, value)
        except TypeError:
            expected = type(known[name]).__name__
            raise ValueError(f"{kind} option '{name}' = {value!r}: give a value of type {expected}") from None


class PairGenerator:
    """Makes batches of synthetic frame pairs.

    Args:
        config: scene options, or ``None`` for the defaults.
        bank_seed: seed of the procedural texture bank.
        device: where scenes are made and returned, for example ``"cpu"`` or ``"cuda"``.
        photos: optional photograph crops, uint8 ``[N, 3, texture_size, texture_size]`` (see :func:`load_photos`).
        share: another generator, whose textures and device are used instead: several kinds of scenes then hold the
            textures in memory once. The options of the textures must be equal.

    Equal config, seeds and shapes give equal bits on a CPU.
    """

    def __init__(
        self,
        config: SceneConfig | Mapping[str, Any] | None = None,
        bank_seed: int = 0,
        device: str | torch.device = "cpu",
        photos: torch.Tensor | None = None,
        share: PairGenerator | None = None,
    ) -> None:
        scene = config if isinstance(config, SceneConfig) else scene_config(config)
        if share is None:
            self._core = _core.PairGenerator(scene, bank_seed, str(device), photos)
        else:
            self._core = _core.PairGenerator(scene, share._core)

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


class Augmenter:
    """Random changes of colour and geometry of frame pairs, with their flow and masks changed alike.

    Args:
        options: augmentation options that differ from the defaults (see :func:`augment_options`), or an
            ``AugmentConfig``. ``preset`` names what to start from: ``standard`` (the defaults), ``authors`` (the six
            photometric changes of the paper's authors, and a crop) or ``none`` (a crop).

    Raises:
        ValueError: an option is unknown, of the wrong type or out of range.
    """

    def __init__(self, options: AugmentConfig | Mapping[str, Any] | None = None) -> None:
        config = options if isinstance(options, AugmentConfig) else augment_config(options)
        self._core = _core.Augmenter(config)

    def __call__(self, batch: Mapping[str, Any], height: int, width: int, seed: int) -> dict[str, Any]:
        """Augmented crops of ``height`` x ``width`` pixels; equal seeds give equal bits on a CPU. The GIL is released.

        ``batch`` holds ``frame1``, ``frame2`` uint8 [B, 3, H, W] RGB and ``flow`` float32 [B, 2, H, W] in pixels, all
        on one device, and may hold ``valid``, ``occlusion``, ``motion_boundary`` bool [B, 1, H, W], ``flow_backward``
        float32 [B, 2, H, W] and the masks' ``_backward`` on frame 2's grid. What is not a tensor is passed on.

        Returns the same keys at the crop's size, and ``valid`` (with a backward flow ``valid_backward``, too): where
        the flow is known. The flow is 0 elsewhere. Points that leave the crop or lie under a patch count as occluded.

        Raises:
            ValueError: a tensor is unknown or has another shape, type or device, or frames would be swapped without
                what that needs.
        """
        tensors = {name: value for name, value in batch.items() if isinstance(value, torch.Tensor)}
        others = {name: value for name, value in batch.items() if name not in tensors}
        return {**others, **self._core.augment(tensors, height, width, seed)}

    @property
    def config(self) -> AugmentConfig:
        """The augmentation options in use."""
        return self._core.config


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
