# SPDX-License-Identifier: MIT
"""The two indoor courses of 7 m x 5 m: play tunnels on end, and boxes of mats."""

from __future__ import annotations

import numpy as np

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import box, tube
from ajna.sim.vehicle import VehicleConfig
from ajna.sim.worlds.rooms import add_room, scattered
from ajna.sim.worlds.scene import Outline, Scene, World

__all__ = ["boxes", "indoor_forest"]

LENGTH_M, WIDTH_M = 7.0, 5.0
RUN_UP_M = 2.5  # the hall is longer than the course
TUNNEL_DIAMETER_M, TUNNEL_HEIGHT_M = 0.48, 1.83
BOX_M = 0.6
MAT_M = (1.37, 0.6)
_FREE_M = 1.05  # between the surfaces of neighbours; the vehicle is 0.51 m wide, 0.65 m across its diagonal


def _course(name: str, scene: Scene, seed: int, camera: CameraModel, height: float, speed: float,
            outlines: list[Outline]) -> World:  # fmt: skip
    return World(
        name=name,
        task="navigate",
        seed=seed,
        model=scene.compile(),
        camera=camera,
        vehicle=scene.vehicle,
        start=np.array([-RUN_UP_M + 0.6, scene.random.uniform(-0.8, 0.8), height]),
        goal=np.array([LENGTH_M, 0.0, height]),
        speed_m_s=speed,
        time_limit_s=20.0,
        bounds=(-RUN_UP_M, LENGTH_M + RUN_UP_M, -WIDTH_M / 2 - 0.7, WIDTH_M / 2 + 0.7),
        outlines=outlines,
    )


def _hall(scene: Scene) -> None:
    scene.light((0.3, 0.4, -0.85), diffuse=0.45, ambient=0.6)
    add_room(scene, (-RUN_UP_M, LENGTH_M + RUN_UP_M + 2), WIDTH_M / 2 + 0.7, 4.5)


def indoor_forest(seed: int, camera: CameraModel, vehicle: VehicleConfig) -> World:
    """Fly 7 m between upright play tunnels, 0.48 m thick and 1.83 m high, at 3.2 m/s."""
    scene = Scene(seed, vehicle)
    _hall(scene)
    radius = TUNNEL_DIAMETER_M / 2
    height = np.linspace(0, TUNNEL_HEIGHT_M, 13)
    axis = np.c_[np.zeros((13, 2)), height]
    ribs = radius * (1 - 0.04 * (np.arange(13) % 2))  # cloth between rings of wire
    tunnel = scene.mesh(tube(axis, ribs, sides=16, tile_m=0.5))
    cloth = [scene.material(scene.surfaces.colored()) for _ in range(5)]
    random = scene.random
    places = scattered(
        random,
        (0.8, LENGTH_M - 0.6),
        (-WIDTH_M / 2 + radius, WIDTH_M / 2 - radius),
        10,
        TUNNEL_DIAMETER_M + _FREE_M,
    )
    outlines = []
    for x, y in places:
        scene.show(tunnel, cloth[random.integers(len(cloth))], (x, y, 0), random.uniform(0, 6))
        scene.solid("cylinder", [radius, TUNNEL_HEIGHT_M / 2], (x, y, TUNNEL_HEIGHT_M / 2))
        outlines.append(Outline.circle(x, y, radius))
    return _course("indoor-forest", scene, seed, camera, 1.0, 3.2, outlines)


def boxes(seed: int, camera: CameraModel, vehicle: VehicleConfig) -> World:
    """Fly 7 m around stacks of cubes of 0.6 m and a mat of 1.37 m x 0.6 m in the middle, at 1.6 m/s."""
    scene = Scene(seed, vehicle)
    _hall(scene)
    random = scene.random
    cube = scene.mesh(box((BOX_M, BOX_M, BOX_M), tile_m=0.6))
    mats = [scene.material(scene.surfaces.surface("mat")) for _ in range(2)]
    mats += [scene.material(scene.surfaces.colored()) for _ in range(3)]
    height = 0.9
    x, y = LENGTH_M / 2 + random.uniform(-0.4, 0.4), random.uniform(-0.6, 0.6)
    # The mat stands on its long side across the way, on two legs, at the height of flight.
    scene.show(box((0.06, *MAT_M), tile_m=0.7), mats[0], (x, y, height))
    scene.solid("box", [0.03, MAT_M[0] / 2, MAT_M[1] / 2], (x, y, height))
    for side in (-0.55, 0.55):
        scene.show(box((0.05, 0.05, height), tile_m=0.3), mats[1], (x, y + side, height / 2))
        scene.solid("box", [0.025, 0.025, height / 2], (x, y + side, height / 2))
    outlines = [Outline.rectangle(x, y, 0.06, MAT_M[0])]
    apart = np.sqrt(2) * BOX_M + 1.0
    darts = scattered(random, (0.8, LENGTH_M - 0.5), (-WIDTH_M / 2 + 0.3, WIDTH_M / 2 - 0.3), 14, apart)
    clear = np.hypot(darts[:, 0] - x, np.maximum(np.abs(darts[:, 1] - y) - MAT_M[0] / 2, 0)) > BOX_M / np.sqrt(2) + 1.0
    for px, py in darts[clear][:8]:
        yaw = random.uniform(0, np.pi / 2)
        for level in range(random.integers(2, 4)):
            z = (level + 0.5) * BOX_M
            scene.show(cube, mats[random.integers(len(mats))], (px, py, z), yaw)
            scene.solid("box", [BOX_M / 2] * 3, (px, py, z), yaw)
        outlines.append(Outline.rectangle(px, py, BOX_M, BOX_M, yaw))
    return _course("boxes", scene, seed, camera, height, 1.6, outlines)
