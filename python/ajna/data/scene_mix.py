# SPDX-License-Identifier: MIT
"""Scenes of one kind, or of a mix of presets of which each batch takes one.

A mix stands in a config as ``scene: {mix: {general: 0.4, dodge: 0.15, navigate: 0.45}}``. The weights need not add up
to 1. Options beside ``mix`` replace those of every preset in it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import torch

from ajna import synth
from ajna.data.seeds import derive_seed


def merge_scenes(run: Mapping[str, Any], stage: Mapping[str, Any]) -> dict[str, Any]:
    """The run's scene options with a stage's over them; a stage's ``preset`` or ``mix`` replaces the run's."""
    kinds = ("preset", "mix")
    kept = {k: v for k, v in run.items() if k not in kinds} if any(kind in stage for kind in kinds) else dict(run)
    return {**kept, **stage}


def scene_configs(options: Mapping[str, Any]) -> dict[str, tuple[float, synth.SceneConfig]]:
    """Weight and scene options of each kind of scenes that ``options`` name; one kind of weight 1 without a mix.

    Raises:
        ValueError: for an unknown preset or option, a weight that is not a finite number of at least 0, weights that
            are all 0, or ``preset`` beside ``mix``.
    """
    if "mix" not in options:
        return {str(options.get("preset", "general")): (1.0, synth.scene_config(options))}
    mix, rest = options["mix"], {name: value for name, value in options.items() if name != "mix"}
    if "preset" in rest:
        raise ValueError("scene options 'preset' and 'mix' were both given: name the preset in the mix")
    if not isinstance(mix, Mapping) or not mix:
        raise ValueError(f"scene option 'mix' = {mix!r}: give presets with weights, for example {{general: 1, gap: 1}}")
    configs = {name: synth.scene_config({**rest, "preset": name}) for name in mix}
    for name, weight in mix.items():
        if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0 <= weight < math.inf:
            raise ValueError(f"scene option mix.{name} = {weight!r}: give a weight of 0 or more")
    if not any(mix.values()):
        raise ValueError("scene option 'mix': all weights are 0: give at least one above 0")
    return {name: (float(mix[name]), config) for name, config in configs.items() if mix[name]}


class MixedScenes:
    """Batches of several kinds of scenes; which kind a batch has follows from its seed.

    Kinds with equal texture options hold their textures in memory once.

    Args:
        options: scene options, with or without ``mix``.
        device: where scenes are made.
        photos: folder with photographs to cut textures from; only for kinds that may use them.
        photo_count: textures cut from them.
        bank_seed: of the textures.
    """

    def __init__(
        self,
        options: Mapping[str, Any],
        device: torch.device | str = "cpu",
        photos: str | None = None,
        photo_count: int = 256,
        bank_seed: int = 0,
    ) -> None:
        self.generators: dict[str, synth.PairGenerator] = {}
        banks: dict[tuple[Any, ...], synth.PairGenerator] = {}
        weights = []
        for name, (weight, config) in scene_configs(options).items():
            uses_photos = photos is not None and config.photo_probability > 0
            textures = (config.bank_size, config.texture_size, config.flat_texture_share)
            key = (*textures, config.repetitive_texture_share, uses_photos)
            if key in banks:
                made = synth.PairGenerator(config, share=banks[key])
            else:
                cuts = None
                if photos is not None and uses_photos:
                    cuts = synth.load_photos(photos, photo_count, config.texture_size, bank_seed)
                made = banks[key] = synth.PairGenerator(config, bank_seed, device, cuts)
            self.generators[name] = made
            weights.append(weight)
        self._bounds = list(accumulate(weights))

    def kind_of(self, seed: int) -> str:
        """The kind of scenes of the batch with this seed."""
        names = list(self.generators)
        place = derive_seed("mix", seed) / 2**62 * self._bounds[-1]
        return names[min(bisect_right(self._bounds, place), len(names) - 1)]

    def __call__(self, batch: int, height: int, width: int, seed: int, flow_scale: float = 1.0) -> synth.PairBatch:
        """As ``ajna.synth.PairGenerator``."""
        return self.generators[self.kind_of(seed)](batch, height, width, seed, flow_scale)

    @property
    def config(self) -> synth.SceneConfig:
        """The options of the first kind of scenes."""
        return next(iter(self.generators.values())).config
