# SPDX-License-Identifier: MIT
"""Synthetic scenes to calibrate on where there is no data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ajna import synth
from ajna.data.frame_pair import FramePair

_CALIBRATION_BIT = 1 << 63  # training seeds lie below 2**62, validation seeds below 2**63: no scene is shared with them


def _seed(run_seed: int, number: int) -> int:
    state = np.random.SeedSequence([run_seed, number]).generate_state(1, np.uint64)
    return _CALIBRATION_BIT | int(state[0]) >> 1


class SyntheticScenes:
    """``count`` scenes of :mod:`ajna.synth`, made when they are read; equal seeds give equal scenes on a CPU.

    Scenes and textures differ from those of every training and validation run.

    Args:
        count: number of scenes.
        width, height: pixels.
        seed: of scenes and textures, not negative.
        photos: folder with photographs to cut textures from, beside the procedural ones.
        photo_count: textures cut from them.
        scene: options of ``ajna.synth.SceneConfig`` that differ from its defaults.

    Raises:
        ValueError: a number or an option out of range, or an unknown option.
        FileNotFoundError: no such folder of photographs.
    """

    def __init__(
        self,
        count: int,
        width: int = 320,
        height: int = 240,
        seed: int = 0,
        photos: str | Path | None = None,
        photo_count: int = 128,
        scene: Mapping[str, Any] | None = None,
    ) -> None:
        if count < 1 or width < 1 or height < 1 or seed < 0:
            raise ValueError(
                f"{count} scenes of {width}x{height} with seed {seed}: give at least 1 scene and pixel, and a seed >= 0"
            )
        self.names = tuple(f"scene_{number:05d}" for number in range(count))
        self.seed, self.width, self.height = seed, width, height
        config = synth.scene_config(scene)
        self._scene = dict(scene or {})
        bank_seed = _seed(seed, 0)
        cuts = None if photos is None else synth.load_photos(photos, photo_count, config.texture_size, bank_seed)
        self._generator = synth.PairGenerator(config, bank_seed, "cpu", cuts)
        self._photos = photos is not None

    def __len__(self) -> int:
        return len(self.names)

    def describe(self) -> str:
        """One line for a model card."""
        options = "".join(f", {name}={value}" for name, value in self._scene.items())
        return f"synthetic scenes {'with' if self._photos else 'without'} photographs, seed {self.seed}{options}"

    def read(self, index: int) -> FramePair:
        """The scene as a pair with flow, occlusion and motion boundaries."""
        index = range(len(self))[index]
        batch = self._generator(1, self.height, self.width, _seed(self.seed, index + 1))

        def picture(tensor: object) -> np.ndarray:
            return np.ascontiguousarray(tensor[0].permute(1, 2, 0).numpy())  # type: ignore[index]

        return FramePair(
            self.names[index],
            picture(batch.frame1),
            picture(batch.frame2),
            flow=picture(batch.flow),
            valid=np.ones((self.height, self.width), dtype=np.bool_),
            occlusion=batch.occlusion[0, 0].numpy(),
            motion_boundary=batch.motion_boundary[0, 0].numpy(),
        )
