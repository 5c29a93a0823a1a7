# SPDX-License-Identifier: MIT
"""Rooms: a floor, four walls, and things on the walls."""

from __future__ import annotations

import numpy as np

from ajna.sim.meshes import box
from ajna.sim.worlds.scene import Scene

__all__ = ["add_room"]


def add_room(scene: Scene, x: tuple[float, float], half_width_m: float, height_m: float, pictures: int = 10) -> None:
    """A room from x[0] to x[1], 2 * half_width_m wide, textured and solid, with boards on its walls."""
    bank = scene.surfaces
    scene.ground(scene.material(bank.surface("concrete"), repeat=0.5), half_size_m=20.0)
    thickness = 0.1
    length, middle = x[1] - x[0], (x[0] + x[1]) / 2
    walls = [
        ((thickness, 2 * half_width_m, height_m), (x[1] + thickness / 2, 0.0, height_m / 2)),
        ((thickness, 2 * half_width_m, height_m), (x[0] - thickness / 2, 0.0, height_m / 2)),
        ((length, thickness, height_m), (middle, half_width_m + thickness / 2, height_m / 2)),
        ((length, thickness, height_m), (middle, -half_width_m - thickness / 2, height_m / 2)),
        ((length, 2 * half_width_m, thickness), (middle, 0.0, height_m + thickness / 2)),
    ]
    for wall, position in walls:
        scene.show(box(wall, tile_m=2.5), scene.material(bank.surface("concrete")), position)
        scene.solid("box", [side / 2 for side in wall], position)
    random = scene.random
    boards = [scene.material(bank.colored()) for _ in range(5)]
    for i in range(pictures):
        size = random.uniform(0.4, 1.3, 2)
        z = random.uniform(0.6, min(height_m - 0.6, 3.2))
        material = boards[i % len(boards)]
        if i % 2 == 0:
            y = random.uniform(-half_width_m + 0.7, half_width_m - 0.7)
            scene.show(box((0.04, size[0], size[1]), tile_m=0.9), material, (x[1] - 0.02, y, z))
        else:
            side = 1.0 if random.random() < 0.5 else -1.0
            along = random.uniform(x[0] + 0.8, x[1] - 0.8)
            scene.show(box((size[0], 0.04, size[1]), tile_m=0.9), material, (along, side * (half_width_m - 0.02), z))


def scattered(
    random: np.random.Generator, x: tuple[float, float], y: tuple[float, float], count: int, apart_m: float
) -> np.ndarray:
    """Up to ``count`` uniform points [N, 2] at least ``apart_m`` from each other (dart throwing, 60 darts a point)."""
    points: list[np.ndarray] = []
    for _ in range(60 * count):
        if len(points) == count:
            break
        dart = np.array([random.uniform(*x), random.uniform(*y)])
        if all(np.hypot(*(dart - point)) >= apart_m for point in points):
            points.append(dart)
    return np.array(points).reshape(-1, 2)
