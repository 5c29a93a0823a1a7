# SPDX-License-Identifier: MIT
"""Surfaces for the worlds, from the texture bank of :mod:`ajna.synth`, recoloured for what they stand for."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ajna.synth import PairGenerator, scene_config

__all__ = ["PALETTES", "SurfaceBank"]

_BANK, _SIZE = 32, 256
_LUMINANCE = np.array([0.299, 0.587, 0.114])

# Dark and light end of the colours of a material, RGB in [0, 1].
PALETTES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "bark": ((0.13, 0.09, 0.06), (0.62, 0.50, 0.38)),
    "leaves": ((0.05, 0.13, 0.03), (0.45, 0.62, 0.22)),
    "ground": ((0.14, 0.12, 0.06), (0.58, 0.55, 0.32)),
    "grass": ((0.10, 0.17, 0.05), (0.55, 0.66, 0.30)),
    "rock": ((0.16, 0.16, 0.17), (0.72, 0.69, 0.64)),
    "concrete": ((0.38, 0.38, 0.38), (0.80, 0.79, 0.76)),
    "paper": ((0.30, 0.30, 0.31), (0.86, 0.84, 0.79)),
    "wood": ((0.32, 0.20, 0.10), (0.80, 0.62, 0.40)),
    "mat": ((0.10, 0.13, 0.22), (0.52, 0.58, 0.72)),
    "sky": ((0.42, 0.58, 0.82), (0.93, 0.95, 0.98)),
}


@lru_cache(maxsize=4)
def _bank(seed: int) -> NDArray[np.float32]:
    """The bank as float32 [N, S, S, 3] in [0, 1]."""
    config = scene_config({"bank_size": _BANK, "texture_size": _SIZE})
    return PairGenerator(config, bank_seed=seed).textures.permute(0, 2, 3, 1).contiguous().numpy()


def _detail(textures: NDArray[np.float32]) -> NDArray[np.float64]:
    """Mean absolute step of the luminance over 4 pixels: how much there is for a camera to hold on to, [N]."""
    grey = textures @ _LUMINANCE
    return np.abs(grey[:, 4:, :] - grey[:, :-4, :]).mean(axis=(1, 2)) + np.abs(grey[:, :, 4:] - grey[:, :, :-4]).mean(
        axis=(1, 2)
    )


class SurfaceBank:
    """Draws textures for one world: equal seeds give equal textures.

    The bank itself is one of eight, so that many worlds in a process share the work of making it.
    """

    def __init__(self, seed: int) -> None:
        self._bank = _bank(seed % 8)
        detail = _detail(self._bank)
        self._lively = np.flatnonzero(detail >= np.median(detail))
        self._random = np.random.default_rng([seed, 0x7E7])

    def _draw(self) -> NDArray[np.float32]:
        return self._bank[self._random.choice(self._lively)]

    def colored(self) -> NDArray[np.uint8]:
        """A texture of the livelier half of the bank in its own colours, uint8 [S, S, 3], that repeats seamlessly."""
        return _repeating(self._draw())

    def surface(self, material: str) -> NDArray[np.uint8]:
        """A texture in the colours of a material of PALETTES, uint8 [S, S, 3], that repeats seamlessly.

        Two textures of the bank are mixed, a coarse one and a fine one, spread over the whole range between the
        palette's ends.
        """
        grey = self._draw() @ _LUMINANCE
        fine = np.tile(_repeating(self._draw()[::2, ::2]) @ _LUMINANCE, (2, 2))[:_SIZE, :_SIZE] / 255
        mixed = _rank(grey) * 0.5 + _rank(fine) * 0.5
        low, high = (np.array(end) for end in PALETTES[material])
        tint = self._random.normal(0, 0.02, 3)
        value = low + (high - low) * mixed[..., None] + tint
        return _repeating(np.clip(value, 0, 1))


def _rank(grey: NDArray[np.floating]) -> NDArray[np.float64]:
    """Spread grey values evenly over [0, 1]: each by the share of pixels that are darker."""
    flat = grey.ravel()
    levels = np.sort(flat)
    return (np.searchsorted(levels, flat, side="left") / flat.size).reshape(grey.shape)


def _repeating(texture: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Mirrored in both directions, then halved in size by averaging: uint8, tiles without seams."""
    doubled = np.concatenate([texture, texture[::-1]], axis=0)
    doubled = np.concatenate([doubled, doubled[:, ::-1]], axis=1)
    halved = (doubled[::2, ::2] + doubled[1::2, ::2] + doubled[::2, 1::2] + doubled[1::2, 1::2]) / 4
    return np.rint(255 * halved).astype(np.uint8)
