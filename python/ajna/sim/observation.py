# SPDX-License-Identifier: MIT
"""What a method gets to see and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import CameraModel, Frame
from ajna.sim.vehicle import Command

__all__ = ["Method", "Observation", "Output", "TaskSetup"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TaskSetup:
    """What a method knows before it starts: the task, its camera, the speed to fly, and a seed for its noise models."""

    task: str
    camera: CameraModel
    speed_m_s: float
    half_width_m: float
    seed: int


@dataclass
class Observation:
    """One frame, with what the flight controller's own sensors (IMU, altimeter, flow sensor) estimate.

    Vectors are in the heading frame: forward, right, down, turned with the yaw but level.
    Methods may use ``frame.rgb``; sensor models that replace a real sensor may use the rest of the frame.
    """

    frame: Frame
    heading_from_camera: Floats  # rotation [3, 3]
    velocity_m_s: Floats  # [3]
    displacement_m: Floats  # from the start, world frame [3]: x to the goal, y left, z up
    yaw_rad: float  # about z up
    height_m: float
    goal_m: Floats  # to the goal [3]
    hold_height_m: float  # the height to fly at

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """RGB uint8 [H, W, 3]."""
        return self.frame.rgb

    def bearing(self, point_px: tuple[float, float]) -> Floats:
        """The direction of an image point in the heading frame, scaled to forward = 1."""
        camera = self.frame.camera
        cx, cy = camera.center_px
        ray = np.array([(point_px[0] - cx) / camera.focal_px, (point_px[1] - cy) / camera.focal_px, 1.0])
        direction = self.heading_from_camera @ ray
        return direction / max(float(direction[0]), 1e-6)

    def pixel(self, direction: Floats) -> tuple[float, float] | None:
        """The image point of a direction in the heading frame; None behind the camera."""
        pixel, z = self.frame.camera.project(self.heading_from_camera.T @ direction)
        return (float(pixel[0]), float(pixel[1])) if z > 1e-6 else None


@dataclass
class Output:
    """A method's answer to a frame.

    mask: bool [H, W]: the obstacle, the thrown object, the gap, the pile, by task; None: no answer yet.
    point_px: where the vehicle should head (safe point), (x, y) in pixels.
    command: for the vehicle. decided: this is the frame on which a detection was acted on. planned: whether the method
    looked at this frame at all; where not, its run time does not count.
    """

    mask: NDArray[np.bool_] | None = None
    point_px: tuple[float, float] | None = None
    command: Command = field(default_factory=Command)
    decided: bool = False
    planned: bool = True


class Method(Protocol):
    """Frames in; mask, point and command out. ``needs`` names the pictures to render before the clock starts.

    What needs "right" has ``baseline_m``, how far to the right the second camera sits.
    """

    name: str
    needs: frozenset[str]  # of "rgb", "right", "depth"

    def reset(self, setup: TaskSetup) -> None:
        """Forget the last trial. Raises ValueError for a task the method does not do."""

    def __call__(self, observation: Observation) -> Output: ...
