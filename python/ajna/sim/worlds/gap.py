# SPDX-License-Identifier: MIT
"""A wall with a gap of unknown shape 3.0 m ahead, and a background 7.2 m ahead."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import box, perforated_wall, sector_prisms
from ajna.sim.vehicle import VehicleConfig
from ajna.sim.worlds.rooms import add_room
from ajna.sim.worlds.scene import GapSetup, Outline, Scene, World

__all__ = ["SHAPES", "gap"]

FOREGROUND_M, BACKGROUND_M = 3.0, 7.2
TOLERANCE_M = 0.08
_THICKNESS_M = 0.04
Floats = NDArray[np.float64]
Contour = Callable[[Floats], Floats]


def _egg(random: np.random.Generator) -> Contour:
    blunt = random.uniform(0.15, 0.25)
    # An ellipse whose width changes along its height.
    return lambda a: 1 / np.sqrt((np.cos(a) * (1 + blunt * np.sin(a))) ** 2 + (np.sin(a) / 1.25) ** 2)


def _spiky(random: np.random.Generator) -> Contour:
    """A figure with spikes of hair all around."""
    spikes, depth = int(random.integers(7, 12)), random.uniform(0.25, 0.4)
    phase = random.uniform(0, 2 * np.pi)
    return lambda a: 1 + depth * np.abs((a + phase) * spikes / np.pi % 2 - 1)


def _infinity(random: np.random.Generator) -> Contour:
    """A lying eight with an open waist (Cassini's oval)."""
    a2, b4 = 1.0, random.uniform(1.06, 1.2)
    return lambda a: np.sqrt(a2 * np.cos(2 * a) + np.sqrt(np.maximum(b4 - (a2 * np.sin(2 * a)) ** 2, 0)))


def _rectangle(random: np.random.Generator) -> Contour:
    aspect = random.uniform(0.6, 1.1)
    return lambda a: 1 / np.maximum(np.abs(np.cos(a)), np.abs(np.sin(a)) / aspect)


def _random(random: np.random.Generator) -> Contour:
    """A smooth random figure: four harmonics of the direction."""
    amplitude = random.normal(0, 1, 4) * np.array([0.16, 0.10, 0.07, 0.05])
    phase = random.uniform(0, 2 * np.pi, 4)
    order = np.arange(2, 6)
    return lambda a: np.maximum(1 + (amplitude * np.sin(np.asarray(a)[..., None] * order + phase)).sum(-1), 0.45)


SHAPES: dict[str, Callable[[np.random.Generator], Contour]] = {
    "egg": _egg,
    "spiky": _spiky,
    "infinity": _infinity,
    "rectangle": _rectangle,
    "random": _random,
}


def _fitted(contour: Contour, vehicle: VehicleConfig) -> Contour:
    """The contour, scaled so that the vehicle fits through its middle with TOLERANCE_M to spare."""
    width = vehicle.half_width_m + TOLERANCE_M
    height = vehicle.half_height_m + TOLERANCE_M
    angle = np.linspace(-np.pi, np.pi, 7201)
    needed = np.minimum(
        width / np.maximum(np.abs(np.cos(angle)), 1e-9), height / np.maximum(np.abs(np.sin(angle)), 1e-9)
    )
    scale = float((needed / contour(angle)).max())
    return lambda a: scale * contour(a)


def gap(seed: int, camera: CameraModel, vehicle: VehicleConfig, shape: str | None = None) -> World:
    """Find the gap, fly through it. ``shape``: a name of SHAPES, by default one drawn from the seed.

    Raises:
        ValueError: for an unknown shape.
    """
    if shape is not None and shape not in SHAPES:
        raise ValueError(f"unknown gap shape '{shape}'; known are {', '.join(SHAPES)}")
    scene = Scene(seed, vehicle)
    random, bank = scene.random, scene.surfaces
    names = list(SHAPES)
    shape = shape or names[random.integers(len(names))]
    scene.light((0.6, 0.3, -0.7), diffuse=0.4, ambient=0.65)
    half_width, height = 2.75, 4.0
    add_room(scene, (-2.0, BACKGROUND_M), half_width, height, pictures=14)
    # Furniture before the background: things a real room has.
    for _ in range(4):
        size = random.uniform([0.3, 0.4, 0.5], [0.5, 0.9, 1.6])
        y = random.uniform(-2.2, 2.2)
        scene.show(box(size, 0.7), scene.material(bank.colored()), (BACKGROUND_M - 0.3, y, size[2] / 2))

    contour = _fitted(SHAPES[shape](random), vehicle)
    start = np.array([0.0, random.uniform(-0.3, 0.3), 1.5])
    center = np.array([FOREGROUND_M, start[1] + random.uniform(-0.5, 0.5), 1.5 + random.uniform(-0.25, 0.25)])
    extent = (half_width - center[1], half_width + center[1], center[2], height - center[2])
    scene.show(
        perforated_wall(contour, extent, _THICKNESS_M, tile_m=3.2), scene.material(bank.surface("paper")), center
    )
    for prism in sector_prisms(contour, extent, _THICKNESS_M):
        scene.hull(prism, center)
    angle = np.linspace(-np.pi, np.pi, 241)
    ring = contour(angle)[:, None] * np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], 1)
    left, right = (float(v) for v in (ring[:, 1].max() + center[1], ring[:, 1].min() + center[1]))
    outlines = [
        Outline.rectangle(FOREGROUND_M, (half_width + left) / 2, _THICKNESS_M, half_width - left),
        Outline.rectangle(FOREGROUND_M, (right - half_width) / 2, _THICKNESS_M, half_width + right),
        Outline.rectangle(BACKGROUND_M, 0, 0.1, 2 * half_width),
    ]
    return World(
        name="gap",
        task="gap",
        seed=seed,
        model=scene.compile(),
        camera=camera,
        vehicle=vehicle,
        start=start,
        goal=np.array([FOREGROUND_M + 1.2, center[1], center[2]]),
        speed_m_s=1.5,
        time_limit_s=12.0,
        bounds=(-2.0, BACKGROUND_M, -half_width, half_width),
        outlines=outlines,
        setup=GapSetup(FOREGROUND_M, ring + center, shape),
    )
