# SPDX-License-Identifier: MIT
"""Building blocks of the worlds: textured surfaces that are seen, simple shapes that are hit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import CameraModel
from ajna.sim.meshes import Mesh
from ajna.sim.render import COLLISION_GROUP, rendering_settings
from ajna.sim.textures import SurfaceBank
from ajna.sim.vehicle import STEP_S, VehicleConfig, add_vehicle

__all__ = ["DodgeSetup", "GapSetup", "Outline", "PileSetup", "Scene", "World"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Outline:
    """Something to draw in a plan view: a closed polygon [N, 2] (x, y in the world)."""

    points: Floats

    @staticmethod
    def circle(x: float, y: float, radius: float) -> Outline:
        angle = np.linspace(0, 2 * np.pi, 25)
        return Outline(np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], 1))

    @staticmethod
    def rectangle(x: float, y: float, length: float, width: float, yaw: float = 0.0) -> Outline:
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * [length / 2, width / 2]
        c, s = np.cos(yaw), np.sin(yaw)
        return Outline(corners @ np.array([[c, s], [-s, c]]) + [x, y])


@dataclass(frozen=True)
class GapSetup:
    """Where the gap is: plane x = ``wall_x``; contour [N, 3] in the world; name of its shape."""

    wall_x: float
    contour: Floats
    shape: str


@dataclass(frozen=True)
class DodgeSetup:
    """The throw: MuJoCo body, kind of object, launch position and velocity in the world, seconds until it would hit."""

    body: str
    kind: str
    position: Floats
    velocity: Floats
    launch_s: float
    flight_s: float


@dataclass(frozen=True)
class PileSetup:
    """Two views of the table: generalised positions of the camera's carrier; name of the kind of scene."""

    views: tuple[Floats, Floats]
    kind: str


@dataclass
class World:
    """A compiled world and what a trial in it needs to know.

    ``task`` is what is flown: navigate, gap, dodge or pile. Positions in metres, world frame (x to the goal, y left,
    z up).
    """

    name: str
    task: str
    seed: int
    model: Any
    camera: CameraModel
    vehicle: VehicleConfig
    start: Floats
    goal: Floats
    speed_m_s: float
    time_limit_s: float
    bounds: tuple[float, float, float, float]  # x and y that count as inside: (x_min, x_max, y_min, y_max)
    outlines: list[Outline] = field(default_factory=list)
    setup: GapSetup | DodgeSetup | PileSetup | None = None
    start_yaw_rad: float = 0.0

    def initial_qpos(self) -> Floats:
        """The vehicle level at its start; everything else where the model puts it."""
        qpos = np.array(self.model.qpos0)
        half = self.start_yaw_rad / 2
        qpos[:7] = [*self.start, np.cos(half), 0, 0, np.sin(half)]
        return qpos


class Scene:
    """Collects surfaces and shapes, then compiles them. The vehicle is the first body in every world."""

    def __init__(self, seed: int, vehicle: VehicleConfig, camera_pitch_rad: float = 0.0) -> None:
        self.random = np.random.default_rng([seed, 0x5CE])
        self.surfaces = SurfaceBank(seed)
        self.vehicle = vehicle
        self.spec = mujoco.MjSpec()
        self.spec.option.timestep = STEP_S
        self.spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        rendering_settings(self.spec)
        add_vehicle(self.spec, vehicle, camera_pitch_rad)
        self._count = 0

    def name(self, stem: str) -> str:
        self._count += 1
        return f"{stem}{self._count}"

    def light(self, direction: Sequence[float], diffuse: float = 0.55, ambient: float = 0.5) -> None:
        """Light from infinity, the same wherever the camera is."""
        self.spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            dir=list(direction),
            pos=[0, 0, 50],
            diffuse=[diffuse] * 3,
            ambient=[ambient] * 3,
            specular=[0, 0, 0],
            castshadow=0,
        )

    def sky(self) -> None:
        """A clear sky: a gradient from the horizon up."""
        self.spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.42, 0.60, 0.86],
            rgb2=[0.88, 0.92, 0.96],
            width=128,
            height=768,
        )

    def material(self, image: NDArray[np.uint8], repeat: float | None = None) -> str:
        """A material of a texture uint8 [S, S, 3]; ``repeat``: tiles per metre, for planes only."""
        name = self.name("surface")
        texture = self.spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=image.shape[1],
            height=image.shape[0],
            nchannel=3,
        )
        texture.data = image.tobytes()
        material = self.spec.add_material(name=name, specular=0.0, shininess=0.0, reflectance=0.0)
        textures = material.textures
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.textures = textures
        if repeat is not None:
            material.texrepeat, material.texuniform = [repeat, repeat], True
        return name

    def mesh(self, mesh: Mesh) -> str:
        """A mesh that can be shown many times."""
        name = self.name("mesh")
        self.spec.add_mesh(
            name=name,
            uservert=mesh.vertices.ravel().tolist(),
            usertexcoord=mesh.texcoords.ravel().tolist(),
            userface=mesh.faces.ravel().tolist(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        return name

    def show(self, mesh: str | Mesh, material: str, position: Sequence[float] | Floats = (0, 0, 0), yaw: float = 0.0,
             quat: Sequence[float] | None = None, body: Any = None) -> None:  # fmt: skip
        """Put a mesh in the world (or on a body): seen, never hit."""
        name = self.mesh(mesh) if isinstance(mesh, Mesh) else mesh
        (body or self.spec.worldbody).add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=material,
            pos=list(position),
            quat=list(quat) if quat is not None else [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
            contype=0,
            conaffinity=0,
            mass=0.0,
            group=0,
        )

    def ground(self, material: str, half_size_m: float = 60.0) -> None:
        """The floor z = 0: seen and hit."""
        self.spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[half_size_m, half_size_m, 1], material=material, group=0
        )

    def solid(self, kind: str, size: Sequence[float], position: Sequence[float] | Floats = (0, 0, 0), yaw: float = 0.0,
              body: Any = None, mass: float = 0.0, fromto: Sequence[float] | None = None) -> None:  # fmt: skip
        """A shape that is hit and not seen: ``kind`` box, cylinder, capsule, sphere; sizes as MuJoCo's (halves)."""
        more: dict[str, Any] = {}
        if fromto is not None:
            more["fromto"] = list(fromto)
        else:
            more["pos"], more["quat"] = list(position), [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        padded = [*size, 0, 0][:3]
        (body or self.spec.worldbody).add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=padded,
            group=COLLISION_GROUP,
            mass=mass,
            rgba=[0, 0, 0, 0],
            **more,
        )

    def hull(self, points: Floats, position: Sequence[float] | Floats) -> None:
        """The convex hull of points [N, 3]: hit, not seen."""
        name = self.name("hull")
        self.spec.add_mesh(
            name=name, uservert=points.ravel().tolist(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        )
        self.spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=list(position), group=COLLISION_GROUP, mass=0.0,
            rgba=[0, 0, 0, 0],
        )  # fmt: skip

    def compile(self) -> Any:
        """The MuJoCo model, with the vehicle's drag."""
        model = self.spec.compile()
        model.dof_damping[:3] = self.vehicle.drag_per_s * self.vehicle.mass_kg
        return model
