# SPDX-License-Identifier: MIT
"""The paper's scenes, each made anew from a seed."""

from __future__ import annotations

from collections.abc import Callable

from ajna import _core
from ajna.sim.camera import CameraModel
from ajna.sim.vehicle import VehicleConfig
from ajna.sim.worlds.dodge import dodge
from ajna.sim.worlds.forest import forest
from ajna.sim.worlds.gap import gap
from ajna.sim.worlds.indoor import boxes, indoor_forest
from ajna.sim.worlds.pile import pile
from ajna.sim.worlds.scene import DodgeSetup, GapSetup, Outline, PileSetup, World

__all__ = ["WORLDS", "DodgeSetup", "GapSetup", "Outline", "PileSetup", "World", "make_world"]

WORLDS: dict[str, Callable[[int, CameraModel, VehicleConfig], World]] = {
    "forest": forest,
    "indoor-forest": indoor_forest,
    "boxes": boxes,
    "gap": gap,
    "dodge": dodge,
    "pile": pile,
}


def make_world(name: str, seed: int, camera: CameraModel | None = None, vehicle: VehicleConfig | None = None) -> World:
    """The world of a name and a seed, compiled; camera and vehicle as in the paper unless given.

    Raises:
        ValueError: for an unknown name (the nearest is named) or a negative seed.
    """
    if name not in WORLDS:
        near = _core.nearest_name(name, list(WORLDS))
        hint = f"did you mean '{near}'? " if near else ""
        raise ValueError(f"unknown world '{name}'; {hint}Known: {', '.join(WORLDS)}")
    if seed < 0:
        raise ValueError(f"seed {seed} is negative: give 0 or more")
    return WORLDS[name](seed, camera or CameraModel(), vehicle or VehicleConfig())
