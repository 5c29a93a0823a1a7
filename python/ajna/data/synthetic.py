# SPDX-License-Identifier: MIT
"""Generated scenes as a data set for scoring: exact flow, occlusion and motion boundaries, no files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ajna import synth
from ajna.data.dataset import FlowDataset
from ajna.data.frame_pair import FramePair

# Training seeds lie below 2**62, and so do the seeds of the texture banks they use.
_HELD_OUT = 1 << 62
_SEEDS = 1 << 20  # data sets, and scenes in one


class SyntheticScenes(FlowDataset):
    """Scenes of `ajna.synth` that no training run sees: seeds and textures are kept apart from those of training.

    A scene is made when it is asked for, and is the same every time.

    Args:
        count: number of scenes.
        width, height: pixels.
        seed: which scenes; 0 to 2**20 - 1.
        motion: multiplies the configured displacements.
        scene: options of `ajna.synth.SceneConfig` that differ from its defaults.

    Raises:
        ValueError: an option out of range, or an unknown scene option.
    """

    title = "synthetic scenes"

    def __init__(
        self,
        count: int = 16,
        width: int = 320,
        height: int = 240,
        seed: int = 0,
        motion: float = 1.0,
        scene: Mapping[str, Any] | None = None,
    ) -> None:
        if not 1 <= count <= _SEEDS:
            raise ValueError(f"{count} scenes: give 1 to {_SEEDS}.")
        if not 0 <= seed < _SEEDS:
            raise ValueError(f"scene seed {seed}: give 0 to {_SEEDS - 1}.")
        if width < 1 or height < 1:
            raise ValueError(f"size {width}x{height} is not a picture; both sides must be at least 1 pixel.")
        super().__init__("synthetic", [f"scene_{index:04d}" for index in range(count)])
        self.width, self.height, self.seed, self.motion = width, height, seed, motion
        self._config = synth.scene_config(scene)
        self._generator: synth.PairGenerator | None = None

    def read(self, index: int) -> FramePair:
        """Scene `index`, at `width` x `height`."""
        if self._generator is None:  # the texture bank takes a second, and memory
            self._generator = synth.PairGenerator(self._config, bank_seed=_HELD_OUT + self.seed)
        seed = _HELD_OUT + self.seed * _SEEDS + index
        made = self._generator(1, self.height, self.width, seed, self.motion)
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
