# SPDX-License-Identifier: MIT
"""A method that sees nothing: what a world does to a vehicle that only flies straight or hovers."""

from __future__ import annotations

import numpy as np

from ajna.sim.methods.base import Map, Mask
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["Blind"]


class Blind:
    """Finds no obstacle, no gap and no object."""

    tasks = frozenset({"navigate", "gap", "dodge", "pile"})
    needs: frozenset[str] = frozenset()

    def reset(self, setup: TaskSetup) -> None: ...

    def depth(self, observation: Observation) -> Map:
        camera = observation.frame.camera
        return np.full((camera.height, camera.width), np.inf, np.float32)

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        return None
