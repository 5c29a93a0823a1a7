# SPDX-License-Identifier: MIT
"""Piles on a table, seen from two views: moss and grass, rocks, household objects."""

from __future__ import annotations

import numpy as np

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import Mesh, box, icosphere, lumpy, merged, tube
from ajna.sim.vehicle import VehicleConfig
from ajna.sim.worlds.scene import Outline, PileSetup, Scene, World

__all__ = ["KINDS", "pile"]

KINDS = ("moss", "rocks", "household")
CONFIGURATIONS = 30  # of each kind in the paper
_DISTANCE_M = 0.75  # from the camera to the middle of the table
_STEP_M = 0.05  # between the two views


def _moss(random: np.random.Generator) -> Mesh:
    """A low clump with blades of grass."""
    size = random.uniform(0.04, 0.09)
    clump = lumpy(icosphere(size, 7, 11), 0.35, random)
    clump = Mesh(clump.vertices * [1, 1, 0.7], clump.texcoords, clump.faces)
    blades = []
    for _ in range(14):
        foot = np.append(random.uniform(-0.7, 0.7, 2) * size, 0.3 * size)
        tip = foot + np.append(random.normal(0, 0.025, 2), random.uniform(0.03, 0.08))
        path = np.stack([foot, (foot + tip) / 2 + np.append(random.normal(0, 0.004, 2), 0.004), tip])
        blades.append(tube(path, np.array([0.0035, 0.003, 0.001]), 4, 0.02, cap=False))
    return merged([clump, *blades])


def _rock(random: np.random.Generator) -> Mesh:
    rock = lumpy(icosphere(random.uniform(0.03, 0.075), 8, 12), 0.3, random, waves=8)
    return Mesh(rock.vertices * random.uniform([0.8, 0.8, 0.6], [1.3, 1.1, 0.95]), rock.texcoords, rock.faces)


def _household(random: np.random.Generator) -> Mesh:
    """A packet, a can, a fruit or a mug."""
    kind = random.integers(4)
    if kind == 0:
        return box(random.uniform([0.05, 0.03, 0.08], [0.12, 0.07, 0.19]), 0.12)
    radius, height = random.uniform(0.028, 0.045), random.uniform(0.07, 0.13)
    z = np.array([-height / 2, height / 2])
    can = tube(np.c_[np.zeros((2, 2)), z], np.full(2, radius), 16, 0.1)
    if kind == 1:
        return can
    if kind == 2:
        return icosphere(random.uniform(0.03, 0.045), 10, 14, tiles=1)
    angle = np.linspace(-1.3, 1.3, 7)
    handle = np.c_[radius + 0.022 * np.cos(angle), np.zeros(7), 0.03 * np.sin(angle)]
    return merged([can, tube(handle, np.full(7, 0.005), 6, 0.05, cap=False)])


_MAKERS = {"moss": _moss, "rocks": _rock, "household": _household}
_OBJECT_MATERIAL = {"moss": "grass", "rocks": "rock", "household": None}
_TABLE_MATERIAL = {"moss": "grass", "rocks": "rock", "household": "wood"}


def _camera_pose(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Generalised position [7] of the carrier so that its x axis points from ``position`` to ``target``."""
    direction = target - position
    yaw, pitch = np.arctan2(direction[1], direction[0]), np.arctan2(-direction[2], np.hypot(*direction[:2]))
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    offset = 0.1 * direction / np.linalg.norm(direction)  # the camera sits before the carrier's origin
    return np.array([*(position - offset), cy * cp, -sy * sp, cy * sp, sy * cp])


def pile(seed: int, camera: CameraModel, vehicle: VehicleConfig, kind: str | None = None) -> World:
    """Tell the pile from the table. ``kind``: a name of KINDS, by default they take turns with the seed.

    Raises:
        ValueError: for an unknown kind of scene.
    """
    if kind is not None and kind not in KINDS:
        raise ValueError(f"unknown kind of pile '{kind}'; known are {', '.join(KINDS)}")
    kind = kind or KINDS[seed % len(KINDS)]
    scene = Scene(seed, vehicle)
    random, bank = scene.random, scene.surfaces
    scene.light((0.4, 0.3, -0.85), diffuse=0.55, ambient=0.5)
    # The table's top is the floor z = 0; there is nothing else to see.
    scene.ground(scene.material(bank.surface(_TABLE_MATERIAL[kind]), repeat=1.6), half_size_m=5.0)
    material = _OBJECT_MATERIAL[kind]
    coats = [scene.material(bank.surface(material) if material else bank.colored()) for _ in range(4)]
    outlines = []
    for _ in range(random.integers(8, 15)):
        mesh = _MAKERS[kind](random)
        spot = random.normal(0, 0.075, 2)
        low = float(mesh.vertices[:, 2].min())
        pressed = 0.006 if kind == "household" else 0.012  # a little into the table, so that nothing hovers
        scene.show(mesh, coats[random.integers(len(coats))], (*spot, -low - pressed), random.uniform(0, 2 * np.pi))
        outlines.append(Outline.circle(spot[0], spot[1], float(np.abs(mesh.vertices[:, :2]).max())))
    tilt = np.deg2rad(random.uniform(48, 68))
    first = _DISTANCE_M * np.array([-np.cos(tilt), 0, np.sin(tilt)])
    sideways = random.uniform(-1, 1)
    step = _STEP_M * np.array([0, np.sign(sideways) * np.cos(sideways), np.sin(abs(sideways))])
    target = np.append(random.normal(0, 0.02, 2), 0.04)
    model = scene.compile()
    views = (_camera_pose(first, target), _camera_pose(first + step, target))
    return World(
        name="pile",
        task="pile",
        seed=seed,
        model=model,
        camera=camera,
        vehicle=vehicle,
        start=views[0][:3],
        goal=views[1][:3],
        speed_m_s=0.0,
        time_limit_s=1.0,
        bounds=(-1.0, 1.0, -1.0, 1.0),
        outlines=outlines,
        setup=PileSetup(views, kind),
    )
