# SPDX-License-Identifier: MIT
"""Generated scenes as a data set for scoring and calibration: exact flow, occlusion and motion boundaries, no files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ajna.data.dataset import FlowDataset
from ajna.data.frame_pair import FramePair
from ajna.data.scene_mix import MixedScenes, scene_configs

_HELD_OUT_BIT = 1 << 63  # training seeds lie below 2**62, validation seeds below 2**63: no scene is shared with them


def _seed(run_seed: int, number: int) -> int:
    state = np.random.SeedSequence([run_seed, number]).generate_state(1, np.uint64)
    return _HELD_OUT_BIT | int(state[0]) >> 1


class SyntheticScenes(FlowDataset):
    """Scenes of `ajna.synth` that no training or validation run sees: seeds and textures are kept apart from theirs.

    A scene is made when it is asked for, and is the same every time on a CPU.

    Args:
        count: number of scenes.
        width, height: pixels.
        seed: of scenes and textures, not negative.
        motion: multiplies the configured displacements.
        photos: folder with photographs to cut textures from, beside the procedural ones.
        photo_count: textures cut from them.
        scene: options of `ajna.synth.SceneConfig` that differ from its defaults; ``preset`` or ``mix`` (see
            :mod:`ajna.data.scene_mix`) names kinds of scenes.

    Raises:
        ValueError: an option out of range, or an unknown scene option.
        FileNotFoundError: no such folder of photographs.
    """

    title = "synthetic scenes"

    def __init__(
        self,
        count: int = 16,
        width: int = 320,
        height: int = 240,
        seed: int = 0,
        motion: float = 1.0,
        photos: str | Path | None = None,
        photo_count: int = 128,
        scene: Mapping[str, Any] | None = None,
    ) -> None:
        if count < 1 or width < 1 or height < 1 or seed < 0:
            raise ValueError(
                f"{count} scenes of {width}x{height} with seed {seed}: give at least 1 scene and pixel, a seed >= 0."
            )
        super().__init__("synthetic", [f"scene_{index:05d}" for index in range(count)])
        self.width, self.height, self.seed, self.motion = width, height, seed, motion
        self.photos, self.photo_count = photos, photo_count
        self._options = dict(scene or {})
        scene_configs(self._options)  # refuses what is not known
        if photos is not None and not Path(photos).is_dir():
            raise FileNotFoundError(f"photograph folder '{photos}' does not exist: give a folder of .jpg or .png files")
        self._generator: MixedScenes | None = None

    def describe(self) -> str:
        """One line for a model card."""
        options = "".join(f", {name}={value}" for name, value in self._options.items())
        return f"synthetic scenes {'with' if self.photos else 'without'} photographs, seed {self.seed}{options}"

    def _made(self) -> MixedScenes:
        if self._generator is None:  # the texture bank takes a second, and memory
            photos = None if self.photos is None else str(self.photos)
            self._generator = MixedScenes(self._options, "cpu", photos, self.photo_count, _seed(self.seed, 0))
        return self._generator

    def read(self, index: int) -> FramePair:
        """Scene `index`, at `width` x `height`."""
        index = range(len(self))[index]
        made = self._made()(1, self.height, self.width, _seed(self.seed, index + 1), self.motion)
        frame1, frame2, flow = (
            np.ascontiguousarray(item[0].permute(1, 2, 0).numpy()) for item in (made.frame1, made.frame2, made.flow)
        )
        return FramePair(
            self.names[index],
            frame1,
            frame2,
            flow,
            np.ones(flow.shape[:2], dtype=np.bool_),
            made.occlusion[0, 0].numpy(),
            made.motion_boundary[0, 0].numpy(),
        )

    def files(self, index: int) -> list[Path]:
        return []

    def parts(self, index: int) -> frozenset[str]:
        return frozenset({"flow", "occlusion", "motion_boundary"})
