# SPDX-License-Identifier: MIT
"""Synthetic scenes as a Lightning data module."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import lightning.pytorch as pl
import torch

from ajna.data.scene_mix import MixedScenes, merge_scenes, scene_configs
from ajna.training.options import Stage, ValidationOptions, check_stages
from ajna.training.seeds import validation_seed
from ajna.training.stream import Batch, SceneStream


class Batches:
    """A fixed sequence of batches as a loader (Lightning takes a list for several loaders)."""

    def __init__(self, batches: Sequence[Batch]) -> None:
        self._batches = list(batches)

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Iterator[Batch]:
        return iter(self._batches)


class SyntheticData(pl.LightningDataModule):
    """Scenes made while training, in batches, on the training device.

    Args:
        stages: the curriculum, in steps.
        scene: options of ``ajna.synth.SceneConfig`` that differ from its defaults; ``preset`` or ``mix`` names scenes.
        validation: the fixed validation scenes; its ``scene`` options are applied over ``scene``.
        seed: of the sample stream. Equal seeds give equal samples, also over a resume.
        prefetch: generated batches held ready by a background thread; 0 generates between the steps.
        photos: folder with photographs to cut textures from.
        photo_count: textures cut from them.
    """

    source = "scenes"

    def __init__(
        self,
        stages: list[Stage],
        scene: dict[str, Any] | None = None,
        validation: ValidationOptions | None = None,
        seed: int = 1,
        prefetch: int = 2,
        photos: str | None = None,
        photo_count: int = 256,
    ) -> None:
        super().__init__()
        if prefetch < 0:
            raise ValueError(f"training option data.prefetch = {prefetch}: give 0 or more")
        self.stages = check_stages(list(stages))
        self.scene, self.validation = dict(scene or {}), validation or ValidationOptions()
        self.seed, self.prefetch, self.photos, self.photo_count = seed, prefetch, photos, photo_count
        # Checked here so that a misspelt option stops the run before it begins.
        for stage in self.stages:
            self._scenes_of(stage)
        self._validation_scenes = merge_scenes(self.scene, self.validation.scene)
        scene_configs(self._validation_scenes)
        self._generator: tuple[dict[str, Any], MixedScenes] | None = None

    def _scenes_of(self, stage: Stage) -> dict[str, Any]:
        options = merge_scenes(self.scene, stage.scene)
        scene_configs(options)
        return options

    def generator(self, stage: Stage, device: torch.device | str = "cpu") -> MixedScenes:
        """The generator of a stage's scenes. The latest is kept: it holds the textures, hundreds of megabytes."""
        if self._generator is None or self._generator[0] != stage.scene:
            self._generator = None  # freed before the next is made
            made = MixedScenes(self._scenes_of(stage), device, self.photos, self.photo_count, bank_seed=self.seed)
            self._generator = (stage.scene, made)
        return self._generator[1]

    def stream(
        self, start: int = 0, rank: int = 0, device: torch.device | str = "cpu", prefetch: int | None = None
    ) -> SceneStream:
        """Training batches from step ``start`` on."""
        ahead = self.prefetch if prefetch is None else prefetch
        return SceneStream(partial(self.generator, device=device), self.stages, self.seed, rank, start, ahead)

    def validation_batches(self) -> list[Batch]:
        """The validation scenes: uint8 frames, flow in pixels and occlusion, on the CPU."""
        options = self.validation
        # Another texture bank than any training run's, so that no texture was seen.
        generator = MixedScenes(
            self._validation_scenes, "cpu", self.photos, self.photo_count, bank_seed=validation_seed(0)
        )
        batches = []
        for number in range(options.batches):
            pairs = generator(options.batch, options.height, options.width, validation_seed(number + 1))
            batches.append({name: getattr(pairs, name) for name in ("frame1", "frame2", "flow", "occlusion")})
        return batches

    def measured(self) -> list[tuple[str, int, int]]:
        """(description, batch, first step) of each stage, for ``throughput``."""
        return [
            (f"{s.height}x{s.width} batch {s.batch} from step {s.from_step} reuse {s.reuse}", s.batch, s.from_step)
            for s in self.stages
        ]

    def describe(self) -> str:
        """One line for a model card: where the samples came from."""
        options = " ".join(f"{name}={value}" for name, value in self.scene.items())
        photos = "with" if self.photos else "without"
        return f"synthetic scenes {photos} photographs, seed {self.seed}" + (f", {options}" if options else "")

    # Lightning hooks. The loaders are plain iterables: scenes need no worker processes.

    def train_dataloader(self) -> SceneStream:
        trainer = self.trainer
        assert trainer is not None
        device = trainer.strategy.root_device
        module: Any = trainer.lightning_module
        return self.stream(module.steps_done, trainer.global_rank, device)

    def val_dataloader(self) -> Batches:
        return Batches(self.validation_batches())
