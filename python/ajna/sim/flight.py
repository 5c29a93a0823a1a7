# SPDX-License-Identifier: MIT
"""Physics between frames: the vehicle follows a command, the shutter opens, something may touch something."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import Frame
from ajna.sim.observation import Observation
from ajna.sim.render import Renderer
from ajna.sim.vehicle import CONTROL_EVERY, STEP_S, VEHICLE, Command, VehicleController
from ajna.sim.worlds import DodgeSetup, World

__all__ = ["Flight"]

Floats = NDArray[np.float64]


class Flight:
    """One trial's physics. ``advance`` flies for one frame interval and gives the frame exposed at its end.

    Args:
        world: where; renderer: of that world's model; seed: of the camera's noise.
    """

    def __init__(self, world: World, renderer: Renderer, seed: int) -> None:
        self.world = world
        self.renderer = renderer
        self._seed = seed
        self._data: Any = mujoco.MjData(world.model)
        self._data.qpos[:] = world.initial_qpos()
        self._body = mujoco.mj_name2id(world.model, mujoco.mjtObj.mjOBJ_BODY, VEHICLE)
        self._is_vehicle = world.model.geom_bodyid == self._body
        self._controller = VehicleController(world.vehicle, world.start_yaw_rad)
        hover = world.vehicle.mass_kg * 9.81 / 4
        self._data.ctrl[:] = hover
        self._data.act[:] = hover
        camera = world.camera
        self._steps = round(1 / camera.rate_hz / STEP_S)
        self._shutter = self._steps - np.linspace(camera.exposure_steps, 0, camera.subframes).round().astype(int)
        self._index = 0
        self._launched = False
        mujoco.mj_forward(world.model, self._data)
        self.collision: str | None = None
        self.path: list[tuple[float, ...]] = [(0.0, *map(float, self.position))]

    @property
    def time_s(self) -> float:
        return float(self._data.time)

    @property
    def position(self) -> Floats:
        """Of the vehicle in the world [3]."""
        return np.array(self._data.qpos[:3])

    @property
    def rotation(self) -> Floats:
        """Of the body (forward, left, up) in the world [3, 3]."""
        return np.array(self._data.xmat[self._body]).reshape(3, 3)

    @property
    def velocity(self) -> Floats:
        """Of the vehicle in the world [3]."""
        return np.array(self._data.qvel[:3])

    def advance(self, command: Command) -> Frame:
        """Fly with ``command`` until the next frame. ``collision`` names what was touched, once something was."""
        states = []
        data, model = self._data, self.world.model
        for step in range(1, self._steps + 1):
            self._launch_if_due()
            if (step - 1) % CONTROL_EVERY == 0:
                rotation = self.rotation
                # A free joint's angular velocity is in the body's frame, its linear one in the world's.
                data.ctrl[:] = self._controller(
                    rotation, data.qvel[:3], data.qvel[3:6], command, CONTROL_EVERY * STEP_S
                )
            mujoco.mj_step(model, data)
            if self.collision is None and data.ncon:
                self._look_for_contact()
            if step in self._shutter:
                states.append(np.array(data.qpos))
        mid = self.time_s - self.world.camera.exposure_steps / 2 * STEP_S
        frame = Frame(self.renderer, states, self._index, mid, self._seed)
        self._index += 1
        self.path.append((self.time_s, *map(float, self.position)))
        return frame

    def _launch_if_due(self) -> None:
        setup = self.world.setup
        if self._launched or not isinstance(setup, DodgeSetup) or self.time_s < setup.launch_s:
            return
        self._launched = True
        joint = mujoco.mj_name2id(self.world.model, mujoco.mjtObj.mjOBJ_JOINT, setup.body)
        position, velocity = self.world.model.jnt_qposadr[joint], self.world.model.jnt_dofadr[joint]
        self._data.qpos[position : position + 3] = setup.position
        self._data.qvel[velocity : velocity + 6] = [*setup.velocity, 0, 0, 0]

    def _look_for_contact(self) -> None:
        model = self.world.model
        for pair in self._data.contact.geom[: self._data.ncon]:
            ours = self._is_vehicle[pair]
            if ours.any() and not ours.all():
                other = int(pair[~ours][0])
                body = model.geom_bodyid[other]
                name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) if body else "world"
                floor = model.geom_type[other] == mujoco.mjtGeom.mjGEOM_PLANE
                self.collision = "ground" if floor else name
                return

    def observe(self, frame: Frame) -> Observation:
        """What the vehicle knows at a frame: attitude, velocity and way flown as its own sensors give them, exactly."""
        pose = frame.T_world_camera
        rotation = frame.poses[2][self._body]
        yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
        c, s = np.cos(yaw), np.sin(yaw)
        heading_from_world = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        position = frame.poses[1][self._body]
        return Observation(
            frame=frame,
            heading_from_camera=heading_from_world @ pose[:3, :3],
            velocity_m_s=heading_from_world @ self.velocity,
            displacement_m=position - self.world.start,
            yaw_rad=yaw,
            height_m=float(position[2]),
            goal_m=heading_from_world @ (self.world.goal - position),
            hold_height_m=float(self.world.start[2]),
        )

    def at_rest(self, qpos: Floats, index: int) -> Frame:
        """A frame of a camera that is held still at given generalised positions."""
        full = np.array(self.world.model.qpos0)
        full[: len(qpos)] = qpos
        return Frame(self.renderer, [full] * self.world.camera.subframes, index, index / self.world.camera.rate_hz,
                     self._seed)  # fmt: skip
