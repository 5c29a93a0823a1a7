# SPDX-License-Identifier: MIT
"""Objects thrown at a hovering vehicle, on paths that hit it if it stays."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import Mesh, box, icosphere, merged, tube
from ajna.sim.vehicle import GRAVITY, VehicleConfig
from ajna.sim.worlds.rooms import add_room
from ajna.sim.worlds.scene import DodgeSetup, Outline, Scene, World

__all__ = ["OBJECTS", "dodge"]

SPEED_M_S = (4.5, 8.0)  # distance over time of flight
DISTANCE_M = (4.8, 6.0)
_LAUNCH_S = 0.6  # the vehicle hovers first
_HALF_WIDTH_M, _HEIGHT_M = 3.2, 5.0
# Full sides in metres (length, width, height) and mass in kg; the first three fall, the fourth flies straight.
OBJECTS: dict[str, tuple[tuple[float, float, float], float]] = {
    "ball": ((0.140, 0.140, 0.140), 0.15),
    "car": ((0.185, 0.095, 0.045), 0.12),
    "airplane": ((0.270, 0.250, 0.160), 0.10),
    "quadrotor": ((0.440, 0.370, 0.160), 0.45),
}


def _shape(kind: str) -> Mesh:
    """The object about its centre, x to its front; its bounding box is that of OBJECTS."""
    (length, width, height), _ = OBJECTS[kind]
    if kind == "ball":
        return icosphere(length / 2, 10, 16, tiles=1)
    if kind == "car":
        body = box((length, width * 0.86, height * 0.5), 0.12)
        cabin = box((length * 0.5, width * 0.7, height * 0.42), 0.12).moved((-0.01, 0, height * 0.29))
        wheels = [
            tube(
                np.array([[x, y - 0.007, -height * 0.28], [x, y + 0.007, -height * 0.28]]), np.full(2, height * 0.22), 8
            )
            for x in (-length * 0.3, length * 0.3)
            for y in (-width / 2 + 0.007, width / 2 - 0.007)
        ]
        return merged([body, cabin, *wheels])
    if kind == "airplane":
        x = np.linspace(-length / 2, length / 2, 6)
        fuselage = tube(
            np.c_[x, np.zeros(6), np.zeros(6)], np.array([0.012, 0.03, 0.036, 0.036, 0.03, 0.008]), 10, 0.15
        )
        wing = box((0.085, width, 0.012), 0.2).moved((0.015, 0, 0.012))
        tail = box((0.05, width * 0.42, 0.008), 0.2).moved((-length / 2 + 0.03, 0, 0.01))
        fin = box((0.055, 0.008, height * 0.62), 0.2).moved((-length / 2 + 0.03, 0, height * 0.31 - 0.01))
        return merged([fuselage, wing, tail, fin])
    parts = [box((0.16, 0.07, height * 0.5), 0.15)]
    up = np.array([0.0, 0.0, 1.0])
    for side_x, side_y in [(1, 1), (1, -1), (-1, 1), (-1, -1)]:
        end = np.array([side_x * (length / 2 - 0.075), side_y * (width / 2 - 0.075), 0.03])
        parts.append(tube(np.stack([[0, 0, 0.0], end * 0.5, end]), np.full(3, 0.011), 6, 0.1))
        parts.append(tube(end + up * np.array([[-0.03], [height / 2 - 0.035]]), np.full(2, 0.016), 8, 0.1))
        disc = end + up * np.array([[height / 2 - 0.04], [height / 2 - 0.03]])
        parts.append(tube(disc, np.full(2, 0.075), 12, 0.1))
    parts.append(box((0.05, 0.05, height * 0.5), 0.1).moved((0, 0, -height * 0.25)))
    return merged(parts)


def _solids(scene: Scene, kind: str, body: Any) -> None:
    (length, width, height), mass = OBJECTS[kind]
    if kind == "ball":
        scene.solid("sphere", [length / 2], body=body, mass=mass)
    elif kind == "airplane":
        scene.solid("capsule", [0.03, length / 2 - 0.03], body=body, mass=mass / 2, fromto=[-0.1, 0, 0, 0.1, 0, 0])
        scene.solid("box", [0.04, width / 2, 0.01], body=body, mass=mass / 2)
    elif kind == "car":
        scene.solid("box", [length / 2, width / 2, height / 2], body=body, mass=mass)
    else:
        scene.solid("box", [length / 2, width / 2, height / 4], body=body, mass=mass)


def dodge(seed: int, camera: CameraModel, vehicle: VehicleConfig, kind: str | None = None) -> World:
    """Hover, and get out of the way. ``kind``: a name of OBJECTS, by default one drawn from the seed.

    The speed of a throw (4.5 to 8.0 m/s) is the distance over the time of flight: at 4.5 m/s along the path a
    falling object would not get as far as 4.8 m.

    Raises:
        ValueError: for an unknown kind of object.
    """
    if kind is not None and kind not in OBJECTS:
        raise ValueError(f"unknown object '{kind}'; known are {', '.join(OBJECTS)}")
    scene = Scene(seed, vehicle)
    random, bank = scene.random, scene.surfaces
    names = list(OBJECTS)
    kind = kind or names[random.integers(len(names))]
    scene.light((0.5, 0.4, -0.75), diffuse=0.45, ambient=0.6)
    add_room(scene, (-2.5, 7.5), _HALF_WIDTH_M, _HEIGHT_M, pictures=16)
    start = np.array([0.0, 0.0, 1.5])

    distance = random.uniform(*DISTANCE_M)
    bearing = np.deg2rad(random.uniform(-22, 22))
    ground_range = distance * np.cos(np.deg2rad(8))
    source = np.array([ground_range * np.cos(bearing), ground_range * np.sin(bearing), random.uniform(1.1, 1.9)])
    flight = distance / random.uniform(*SPEED_M_S)
    velocity = (start - source) / flight
    if kind != "quadrotor":
        velocity = velocity + np.array([0, 0, GRAVITY * flight / 2])
    heading = np.arctan2(velocity[1], velocity[0])
    # It waits far above the room until it is thrown.
    body = scene.spec.worldbody.add_body(name="thrown", pos=[0, 0, 40], gravcomp=1.0 if kind == "quadrotor" else 0.0)
    body.add_freejoint(name="thrown")
    scene.show(_shape(kind), scene.material(bank.colored()), body=body)
    _solids(scene, kind, body)
    model = scene.compile()
    half = heading / 2
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "thrown")
    address = model.jnt_qposadr[number]
    model.qpos0[address + 3 : address + 7] = [np.cos(half), 0, 0, np.sin(half)]
    return World(
        name="dodge",
        task="dodge",
        seed=seed,
        model=model,
        camera=camera,
        vehicle=vehicle,
        start=start,
        goal=start,
        speed_m_s=0.0,
        time_limit_s=_LAUNCH_S + flight + 0.35,
        bounds=(-2.5, 7.5, -_HALF_WIDTH_M, _HALF_WIDTH_M),
        outlines=[Outline.rectangle(2.5, 0, 10.0, 2 * _HALF_WIDTH_M)],
        setup=DodgeSetup("thrown", kind, source, velocity, _LAUNCH_S, flight),
    )
