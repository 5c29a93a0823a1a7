# SPDX-License-Identifier: MIT
"""The quadrotor: a rigid body driven by four rotors, and the controller that follows commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ajna.sim.render import CAMERA, VEHICLE_GROUP

__all__ = [
    "CAMERA_AHEAD_M",
    "GRAVITY",
    "STEP_S",
    "VEHICLE",
    "Command",
    "VehicleConfig",
    "VehicleController",
    "add_vehicle",
]

VEHICLE = "vehicle"
STEP_S = 1 / 600  # of the physics
CONTROL_EVERY = 2  # physics steps per controller step
GRAVITY = 9.81
CAMERA_AHEAD_M = 0.1  # of the body's middle
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class VehicleConfig:
    """The paper's vehicle where it gives a figure: frame 500 mm from motor to motor, 1110 g, 4.9 : 1 thrust to weight.

    Inertia is estimated from four motors of 60 g at the arms' ends and the rest within 8 cm of the centre.
    """

    mass_kg: float = 1.11
    thrust_to_weight: float = 4.9
    inertia_kg_m2: tuple[float, float, float] = (0.0090, 0.0090, 0.0165)
    motor_distance_m: float = 0.5  # diagonal, motor to motor
    rotor_radius_m: float = 0.076  # 6 inch
    half_height_m: float = 0.04
    torque_per_thrust_m: float = 0.016
    motor_lag_s: float = 0.03
    drag_per_s: float = 0.12  # linear, of the velocity
    max_tilt_rad: float = np.deg2rad(60.0)  # that a thrust command may ask for
    cruise_tilt_rad: float = np.deg2rad(35.0)  # that a velocity command may ask for
    max_rate_rad_s: float = 9.0  # roll and pitch
    max_yaw_rate_rad_s: float = 3.0
    max_climb_m_s2: float = 12.0  # vertical acceleration that a command may ask for
    velocity_gain: float = 4.0  # 1/s
    velocity_integral: float = 0.8  # 1/s^2
    attitude_gain: float = 11.0  # 1/s
    rate_gain: float = 26.0  # 1/s

    @property
    def arm_m(self) -> float:
        """Distance of a motor from the centre along x, and along y."""
        return self.motor_distance_m / 2 / np.sqrt(2)

    @property
    def max_thrust_n(self) -> float:
        return self.thrust_to_weight * self.mass_kg * GRAVITY

    @property
    def half_width_m(self) -> float:
        """Half the width over the rotor discs, seen from the front."""
        return self.arm_m + self.rotor_radius_m


@dataclass(frozen=True)
class Command:
    """What a pilot asks for, in the heading frame: forward, right, down, turned with the yaw but level.

    Either a velocity, or a thrust vector per mass (what the rotors should do, gravity not subtracted: hovering is
    (0, 0, -9.81)). Yaw rate: positive turns right, as seen from above.
    """

    velocity_m_s: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    yaw_rate_rad_s: float = 0.0
    thrust_m_s2: tuple[float, float, float] | None = None


def add_vehicle(spec: Any, config: VehicleConfig, camera_pitch_rad: float = 0.0) -> None:
    """Add body, rotors, collision shapes and camera to a MuJoCo spec; ``camera_pitch_rad`` turns the camera up."""
    body = spec.worldbody.add_body(name=VEHICLE)
    body.add_freejoint(name=VEHICLE)
    body.mass, body.inertia = config.mass_kg, list(config.inertia_kg_m2)
    body.ipos, body.explicitinertial = [0, 0, 0], 1
    arm, radius = config.arm_m, config.rotor_radius_m
    dark, light = [0.12, 0.12, 0.14, 1.0], [0.85, 0.35, 0.1, 1.0]
    geom = mujoco.mjtGeom

    def add(kind: Any, size: list[float], pos: list[float], rgba: list[float], **more: Any) -> None:
        body.add_geom(type=kind, size=size, pos=pos, rgba=rgba, group=VEHICLE_GROUP, mass=0.0, **more)

    add(geom.mjGEOM_BOX, [0.08, 0.05, config.half_height_m], [0, 0, 0], light)
    for sign in (1, -1):
        turned = [np.cos(np.pi / 8 * sign), 0, 0, np.sin(np.pi / 8 * sign)]
        add(geom.mjGEOM_BOX, [config.motor_distance_m / 2, 0.015, 0.008], [0, 0, 0], dark, quat=turned)
    # Motors in turn: front left, front right, rear right, rear left; neighbours spin in opposite directions.
    for i, (x, y) in enumerate([(arm, arm), (arm, -arm), (-arm, -arm), (-arm, arm)]):
        add(geom.mjGEOM_CYLINDER, [radius, 0.008, 0], [x, y, 0.03], [*dark[:3], 0.7])
        body.add_site(name=f"rotor{i}", pos=[x, y, 0])
        actuator = spec.add_actuator(name=f"rotor{i}", target=f"rotor{i}", trntype=mujoco.mjtTrn.mjTRN_SITE)
        actuator.gear = [0, 0, 1, 0, 0, config.torque_per_thrust_m * (-1) ** i]
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = config.motor_lag_s
        actuator.ctrllimited, actuator.ctrlrange = 1, [0, config.max_thrust_n / 4]
    # x right = -y of the body, y up = z of the body; then turned up about the camera's x axis
    c, s = np.cos(camera_pitch_rad), np.sin(camera_pitch_rad)
    rotation = np.array([[0.0, -s, -c], [-1.0, 0.0, 0.0], [0.0, c, -s]])
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    body.add_camera(name=CAMERA, pos=[CAMERA_AHEAD_M, 0, 0], quat=quat)


def _cross(a: Floats, b: Floats) -> Floats:
    """np.cross for single vectors, without its overhead, which counts at 300 calls a second."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class VehicleController:
    """Geometric tracking on SO(3) (Lee, Leok, McClamroch 2010) of a thrust direction and a heading.

    The outer loop turns a velocity command into an acceleration; tilt, rates and climb are limited, then the rotors'
    thrusts, where roll and pitch moments come before total thrust and yaw.
    """

    def __init__(self, config: VehicleConfig, yaw_rad: float = 0.0) -> None:
        self.config = config
        self._yaw = yaw_rad
        self._integral = np.zeros(3)
        arm, torque = config.arm_m, config.torque_per_thrust_m
        # total thrust and moments (x, y, z) from the rotors' thrusts
        mixer = np.array(
            [[1, 1, 1, 1], [arm, -arm, -arm, arm], [-arm, -arm, arm, arm], [torque, -torque, torque, -torque]]
        )
        self._unmix = np.linalg.inv(mixer)
        self._inertia = np.array(config.inertia_kg_m2)

    def _acceleration(self, command: Command, velocity: Floats, yaw: float, dt: float) -> Floats:
        """The thrust per mass in the world (z up) that a command asks for, limited in tilt and climb."""
        config = self.config
        c, s = np.cos(yaw), np.sin(yaw)

        def to_world(frd: tuple[float, float, float]) -> Floats:
            return np.array([c * frd[0] + s * frd[1], s * frd[0] - c * frd[1], -frd[2]])

        if command.thrust_m_s2 is not None:
            wanted, tilt = to_world(command.thrust_m_s2), config.max_tilt_rad
        else:
            tilt = config.cruise_tilt_rad
            error = to_world(command.velocity_m_s or (0.0, 0.0, 0.0)) - velocity
            if np.abs(error).max() < 1.0:  # only near the goal: no wind-up on steps
                self._integral = np.clip(self._integral + config.velocity_integral * error * dt, -2.0, 2.0)
            wanted = config.velocity_gain * error + self._integral
            wanted[2] = np.clip(wanted[2], -0.6 * GRAVITY, config.max_climb_m_s2) + GRAVITY
        wanted[2] = max(wanted[2], 0.2 * GRAVITY)
        horizontal, limit = np.hypot(wanted[0], wanted[1]), wanted[2] * np.tan(tilt)
        if horizontal > limit:
            wanted[:2] *= limit / horizontal
        return wanted

    def __call__(self, rotation: Floats, velocity: Floats, rates: Floats, command: Command, dt: float) -> Floats:
        """Rotor thrusts [4] in newtons.

        Args:
            rotation: of the body in the world [3, 3] (body: forward, left, up).
            velocity: in the world [3]; rates: in the body [3].
            command: to follow; dt: seconds since the last call.
        """
        config = self.config
        yaw_rate = float(np.clip(command.yaw_rate_rad_s, -config.max_yaw_rate_rad_s, config.max_yaw_rate_rad_s))
        self._yaw -= yaw_rate * dt  # our yaw rate turns right, the angle about z up turns left
        heading = np.arctan2(rotation[1, 0], rotation[0, 0])
        wanted = self._acceleration(command, velocity, float(heading), dt)
        thrust = config.mass_kg * max(float(wanted @ rotation[:, 2]), 0.0)

        z = wanted / np.linalg.norm(wanted)
        y = _cross(z, np.array([np.cos(self._yaw), np.sin(self._yaw), 0.0]))
        y /= np.linalg.norm(y)
        target = np.stack([_cross(y, z), y, z], axis=1)
        skew = target.T @ rotation - rotation.T @ target
        error = 0.5 * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        aim = -config.attitude_gain * error
        aim[2] = np.clip(aim[2], -config.max_yaw_rate_rad_s, config.max_yaw_rate_rad_s) - yaw_rate
        aim[:2] *= min(1.0, config.max_rate_rad_s / max(float(np.hypot(aim[0], aim[1])), 1e-9))
        moment = self._inertia * config.rate_gain * (aim - rates) + _cross(rates, self._inertia * rates)
        return self._allocate(thrust, moment)

    def _allocate(self, thrust: float, moment: Floats) -> Floats:
        """Rotor thrusts within their range: yaw gives way first, then the total thrust, never roll and pitch."""
        limit = self.config.max_thrust_n / 4
        tilt = self._unmix[:, 1:3] @ moment[:2]
        span = tilt.max() - tilt.min()
        if span > limit:
            tilt *= limit / span
        base = np.clip(thrust / 4, -tilt.min(), limit - tilt.max())
        rotors = base + tilt
        yaw = self._unmix[:, 3] * moment[2]
        room = np.where(yaw > 0, limit - rotors, rotors)
        share = np.min(np.where(np.abs(yaw) > 1e-12, room / np.maximum(np.abs(yaw), 1e-12), np.inf))
        return np.clip(rotors + yaw * min(1.0, max(share, 0.0)), 0.0, limit)
