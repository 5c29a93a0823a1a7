# SPDX-License-Identifier: MIT
"""The control policies that all reference methods share: from what was perceived to a point and a command."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.vehicle import GRAVITY, Command

__all__ = ["DodgePilot", "GapPilot", "NavigatePilot", "mask_center"]

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def mask_center(mask: Mask) -> tuple[float, float]:
    """The median of a region's pixels, (x, y)."""
    rows, columns = np.nonzero(mask)
    return float(np.median(columns)), float(np.median(rows))


def _climb(observation: Observation) -> float:
    """The vertical velocity (down) that holds the height."""
    return float(np.clip(1.5 * (observation.height_m - observation.hold_height_m), -1.0, 1.0))


class NavigatePilot:
    """Flies towards the goal where the depth map is free.

    Every image column gives its nearest point at the height of flight. Over a fan of directions the free length of a
    corridor as wide as the vehicle is measured; the direction is chosen that is long, wide, and near the goal's.
    Points seen in the last second still count when they have left the picture.
    """

    HORIZON_M = 9.0
    BAND_M = 0.30  # of heights around the vehicle that can be hit
    MEMORY_FRAMES = 24
    BRAKE_M_S2 = 4.0

    def __init__(self, setup: TaskSetup) -> None:
        self._setup = setup
        self._fan = np.deg2rad(np.linspace(-40, 40, 81))
        self._memory: deque[Floats] = deque(maxlen=self.MEMORY_FRAMES)
        self._last = 0.0

    def _points(self, depth: NDArray[np.floating], observation: Observation) -> Floats:
        """The nearest point of each second column at the height of flight, (forward, right) in the heading frame."""
        z = np.asarray(depth[::2, ::2], dtype=np.float64)
        rays = observation.frame.camera.rays[::2, ::2]
        finite = np.isfinite(z) & (z < self.HORIZON_M * 1.5)
        points = np.where(finite, z, 0.0)[..., None] * rays @ observation.heading_from_camera.T
        hit = finite & (np.abs(points[..., 2]) < self.BAND_M) & (observation.height_m - points[..., 2] > 0.15)
        distance = np.where(hit, np.hypot(points[..., 0], points[..., 1]), np.inf)
        row = distance.argmin(axis=0)
        columns = np.arange(z.shape[1])
        return points[row, columns, :2][np.isfinite(distance[row, columns])]

    def _remembered(self, points: Floats, observation: Observation) -> Floats:
        """The points with those of the last frames, carried along by the odometry."""
        c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
        to_world = np.array([[c, s], [s, -c]])  # (forward, right) -> (x, y left); its own inverse
        here = observation.displacement_m[:2]
        near = points[np.hypot(points[:, 0], points[:, 1]) < 4.0]
        old = [(world - here) @ to_world for world in self._memory]
        self._memory.append(near @ to_world + here)
        return np.concatenate([points, *old]) if old else points

    def _free(self, points: Floats, clearance: float) -> Floats:
        """How far each direction of the fan is free of points within ``clearance`` of its line, metres."""
        direction = np.stack([np.cos(self._fan), np.sin(self._fan)], 1)
        along = direction @ points.T
        across = np.abs(direction[:, :1] * points[:, 1] - direction[:, 1:] * points[:, 0])
        blocked = np.where((across < clearance) & (along > -0.2), np.maximum(along, 0.0), np.inf)
        return np.minimum(blocked.min(axis=1, initial=np.inf), self.HORIZON_M)

    def __call__(self, depth: NDArray[np.floating], observation: Observation) -> Output:
        """``depth``: metres [H, W], infinite or NaN where nothing is known to be."""
        setup = self._setup
        points = self._remembered(self._points(depth, observation), observation)
        tight = setup.half_width_m * 1.3 + 0.12
        narrow, wide = self._free(points, tight), self._free(points, tight + 0.3)
        goal = float(np.clip(np.arctan2(observation.goal_m[1], observation.goal_m[0]), -1.2, 1.2))
        score = (
            narrow / self.HORIZON_M
            + 0.35 * wide / self.HORIZON_M
            - 0.45 * np.abs(self._fan - goal)
            - 0.12 * np.abs(self._fan - self._last)
        )
        best = int(score.argmax())
        angle, free = float(self._fan[best]), float(narrow[best])
        self._last = angle
        speed = min(setup.speed_m_s, float(np.sqrt(2 * self.BRAKE_M_S2 * max(free - 0.3, 0.0))))
        # Points the nose at the way it goes; where all is blocked, turns until something opens.
        yaw_rate = 2.5 * angle if free > 0.8 else 1.2 * (1.0 if angle >= 0 else -1.0)
        command = Command((speed * np.cos(angle), speed * np.sin(angle), _climb(observation)), yaw_rate)
        near = np.isfinite(depth) & (depth < free)
        return Output(near, observation.pixel(np.array([np.cos(angle), np.sin(angle), 0.0])), command)


class GapPilot:
    """Explores along a diagonal until a gap is found, lines up with its middle, flies through."""

    SETTLE_S, EXPLORE_S = 0.3, 0.8
    ALIGNED = 0.03  # sideways over forward
    GAIN = 2.2  # m/s per unit of sideways over forward

    def __init__(self, setup: TaskSetup) -> None:
        self._setup = setup
        self._found = False
        self._aligned = 0
        self._passing = False

    @property
    def searching(self) -> bool:
        """Whether no gap has been acted on yet."""
        return not self._found

    def exploring(self, time_s: float) -> bool:
        """Whether the exploratory motion is going on at a time."""
        return self.SETTLE_S <= time_s < self.SETTLE_S + self.EXPLORE_S

    def __call__(self, mask: Mask | None, observation: Observation) -> Output:
        """``mask``: the gap in this frame, or None where there is none to see."""
        time_s = observation.frame.time_s
        home = Command((0.0, 0.0, _climb(observation)))
        if not self._found and time_s < self.SETTLE_S:
            return Output(None, None, home)
        if not self._found and self.exploring(time_s):
            sign = 1.0 if time_s < self.SETTLE_S + self.EXPLORE_S / 2 else -1.0
            return Output(mask, None, Command((0.0, 0.5 * sign, -0.3 * sign)))
        if mask is None or not mask.any():
            return Output(None, None, Command((self._setup.speed_m_s, 0.0, 0.0)) if self._passing else home)
        decided, self._found = not self._found, True
        point = mask_center(mask)
        _, right, down = observation.bearing(point)
        width = float(mask.any(axis=0).mean())
        if self._passing and (width > 0.75 or mask[:, [0, -1]].any()):
            return Output(mask, point, Command((self._setup.speed_m_s, 0.0, 0.0)), decided)
        sideways, sink = self.GAIN * float(right), self.GAIN * float(down)
        self._aligned = self._aligned + 1 if max(abs(right), abs(down)) < self.ALIGNED else 0
        self._passing = self._passing or self._aligned >= 5
        # Forward only as fast as the line-up allows.
        off = max(abs(right), abs(down))
        forward = self._setup.speed_m_s * float(np.clip(1.2 - off / 0.12, 0.0, 1.0)) if self._passing else 0.0
        limit = 1.2
        command = Command((forward, float(np.clip(sideways, -limit, limit)), float(np.clip(sink, -limit, limit))))
        return Output(mask, point, command, decided)


class DodgePilot:
    """Hovers; when something was seen in three frames, moves across its path with full tilt, then stops."""

    FRAMES = 3
    BURST_S = 0.30
    SIDE_M_S2 = 16.0
    LARGEST_JUMP_PX = 60.0

    def __init__(self, setup: TaskSetup) -> None:
        self._setup = setup
        self._track: list[tuple[float, float]] = []
        self._since: float | None = None
        self._side = 0.0

    def __call__(self, mask: Mask | None, observation: Observation) -> Output:
        """``mask``: the thrown object in this frame, or None where there is none to see."""
        time_s = observation.frame.time_s
        if self._since is not None:
            age = time_s - self._since
            if age < self.BURST_S:
                return Output(mask, None, self._burst())
            # The way back to hovering: the controller's tilt limit for velocities brakes it.
            return Output(mask, None, Command((0.0, 0.0, _climb(observation))))
        away = observation.displacement_m
        c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
        back = -1.5 * np.array([c * away[0] + s * away[1], s * away[0] - c * away[1]])
        hover = Command((float(back[0]), float(back[1]), _climb(observation)), 2.0 * observation.yaw_rad)
        if mask is None or not mask.any():
            self._track.clear()
            return Output(mask, None, hover)
        point = mask_center(mask)
        if self._track and np.hypot(*np.subtract(point, self._track[-1])) > self.LARGEST_JUMP_PX:
            self._track.clear()
        self._track.append(point)
        if len(self._track) < self.FRAMES:
            return Output(mask, point, hover)
        self._since = time_s
        self._side = self._direction(observation)
        return Output(mask, point, self._burst(), decided=True)

    def _direction(self, observation: Observation) -> float:
        """+1 right, -1 left: away from where the object is heading on the image plane.

        Its position is extrapolated by one more track length; what comes from one side and drifts to the other is
        let pass behind.
        """
        first, last = self._track[0], self._track[-1]
        ahead = last[0] + (last[0] - first[0])
        center = observation.frame.camera.center_px[0]
        return -1.0 if ahead > center else 1.0

    def _burst(self) -> Command:
        return Command(None, 0.0, (0.0, self.SIDE_M_S2 * self._side, -GRAVITY))
