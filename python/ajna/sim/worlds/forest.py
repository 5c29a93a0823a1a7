# SPDX-License-Identifier: MIT
"""The simulated forest: 40 m x 20 m, trees 0.6 to 0.9 m thick, at least 3 m apart."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import Mesh, icosphere, lumpy, merged, tube
from ajna.sim.vehicle import VehicleConfig
from ajna.sim.worlds.rooms import scattered
from ajna.sim.worlds.scene import Outline, Scene, World

__all__ = ["forest"]

LENGTH_M, WIDTH_M = 40.0, 20.0
APART_M = 3.0
DIAMETER_M = (0.6, 0.9)
TREES = 50  # in 40 m x 20 m; darts at 3 m stop fitting at about 60
MARGIN_M = 4.0  # the same forest goes on around the area
FLIGHT_HEIGHT_M = 1.5
_TRUNK_M = 6.0


def _tree(random: np.random.Generator, radius: float) -> tuple[Mesh, np.ndarray]:
    """A trunk with branches, its foot at the origin, and its axis [N, 3]."""
    height = np.linspace(-0.05, _TRUNK_M, 6)
    lean, bend = random.normal(0, 0.02, 2), random.normal(0, 0.006, 2)
    axis = np.stack([lean[0] * height + bend[0] * height**2, lean[1] * height + bend[1] * height**2, height], 1)
    axis[:, :2] -= axis[0, :2]
    taper = np.interp(height, [-0.05, 0.25, 3.0, _TRUNK_M], [1.0, 1.0, 0.92, 0.7]) * radius
    parts = [tube(axis, taper, sides=11, tile_m=0.9)]
    for _ in range(random.integers(3, 7)):
        z = random.uniform(2.6, 5.2)
        foot = np.array([np.interp(z, height, axis[:, 0]), np.interp(z, height, axis[:, 1]), z])
        azimuth, rise = random.uniform(0, 2 * np.pi), random.uniform(0.15, 0.7)
        direction = np.array([np.cos(azimuth), np.sin(azimuth), rise])
        reach = random.uniform(0.9, 1.9)
        steps = np.linspace(0, 1, 4)[:, None]
        path = foot + steps * reach * direction + steps**2 * np.array([0, 0, 0.25])
        parts.append(tube(path, np.linspace(0.09, 0.025, 4) * random.uniform(0.7, 1.2), sides=5, tile_m=0.3, cap=False))
    return merged(parts), axis


def _crown(random: np.random.Generator) -> Mesh:
    """Leaves: a few lumpy balls around the top of a trunk."""
    parts = []
    for _ in range(3):
        ball = lumpy(icosphere(random.uniform(0.9, 1.5), 5, 7, tiles=2), 0.25, random)
        parts.append(ball.moved(random.uniform([-1.3, -1.3, 4.3], [1.3, 1.3, 6.2])))
    return merged(parts)


def forest(seed: int, camera: CameraModel, vehicle: VehicleConfig) -> World:
    """Fly through 40 m of forest at 4.8 m/s."""
    scene = Scene(seed, vehicle)
    random, bank = scene.random, scene.surfaces
    scene.sky()
    scene.light((0.4, 0.5, -0.8))
    scene.ground(scene.material(bank.surface("ground"), repeat=0.35), half_size_m=90.0)

    # Far trees: a round curtain seen from inside; the ground reaches beyond it.
    angle = np.linspace(0, -2 * np.pi, 49)
    ring = np.stack([20 + 55 * np.cos(angle), 55 * np.sin(angle)], 1)
    vertices = np.concatenate([np.c_[ring, np.full(49, -0.5)], np.c_[ring, 6 + random.uniform(0, 5, 49)]])
    vertices[-1] = vertices[49]
    texcoords = np.c_[np.tile(np.linspace(0, 40, 49), 2), np.repeat([0.0, 1.6], 49)]
    i = np.arange(48)
    faces = np.concatenate([np.c_[i, i + 1, i + 50], np.c_[i, i + 50, i + 49]]).astype(np.int32)
    scene.show(Mesh(vertices, texcoords, faces), scene.material(bank.surface("leaves")))

    bark = [scene.material(bank.surface("bark")) for _ in range(5)]
    leaves = [scene.material(bank.surface("leaves")) for _ in range(3)]
    kinds = []
    for radius in np.linspace(DIAMETER_M[0] / 2, DIAMETER_M[1] / 2, 10):
        trunk, axis = _tree(random, radius)
        kinds.append((radius, scene.mesh(trunk), axis))
    crowns = [scene.mesh(_crown(random)) for _ in range(4)]

    area = (LENGTH_M + MARGIN_M) * (WIDTH_M + 2 * MARGIN_M)
    count = round(TREES * area / (LENGTH_M * WIDTH_M))
    places = scattered(
        random, (0, LENGTH_M + MARGIN_M), (-WIDTH_M / 2 - MARGIN_M, WIDTH_M / 2 + MARGIN_M), count, APART_M
    )
    outlines = []
    for x, y in places:
        radius, trunk_name, axis = kinds[random.integers(len(kinds))]
        yaw = random.uniform(0, 2 * np.pi)
        scene.show(trunk_name, bark[random.integers(len(bark))], (x, y, 0), yaw)
        scene.show(crowns[random.integers(len(crowns))], leaves[random.integers(len(leaves))], (x, y, 0), yaw)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        points = axis[[0, 1, 3]] @ turn.T + [x, y, 0]  # to about 3.5 m; nobody flies higher
        for a, b in pairwise(points):
            scene.solid("capsule", [radius], fromto=[*a, *b])
        outlines.append(Outline.circle(x, y, radius))
    return World(
        name="forest",
        task="navigate",
        seed=seed,
        model=scene.compile(),
        camera=camera,
        vehicle=vehicle,
        start=np.array([-4.0, random.uniform(-3, 3), FLIGHT_HEIGHT_M]),
        goal=np.array([LENGTH_M, 0.0, FLIGHT_HEIGHT_M]),
        speed_m_s=4.8,
        time_limit_s=20.0,
        bounds=(-6.0, LENGTH_M + 5, -WIDTH_M / 2 - 2, WIDTH_M / 2 + 2),
        outlines=outlines,
    )
