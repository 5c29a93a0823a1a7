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

    Every image column gives its nearest point at the height of flight; points seen in the last two seconds still count
    when they have left the picture. A fan of velocity commands is tried out on a simple model of the vehicle, which
    follows them with a lag and a limited acceleration, and the way that each gives is held against the points. Of those
    that leave time to stop, the one is flown that comes nearest to the goal, with room to spare.
    """

    HORIZON_M = 9.0
    BAND_M = 0.30  # of heights around the vehicle that can be hit
    MEMORY_FRAMES, MEMORY_M, CELL_M = 60, 5.0, 0.15
    STEP_S, STEPS = 0.08, 22  # of the ways tried out
    GAIN_PER_S, LAG_S, LIMIT_M_S2 = 4.0, 0.12, 6.5  # how the vehicle follows a velocity command
    STOP_M_S2, STOP_LAG_S = 4.0, 0.35  # what is counted on for braking
    SPEEDS = (1.0, 0.6, 0.25)  # tried out, shares of the speed to fly

    def __init__(self, setup: TaskSetup) -> None:
        self._setup = setup
        fan = np.deg2rad(np.linspace(-45, 45, 31))
        self._angles = np.tile(fan, len(self.SPEEDS))
        self._speeds = np.repeat(np.array(self.SPEEDS) * setup.speed_m_s, len(fan))
        self._commands = self._speeds[:, None] * np.stack([np.cos(self._angles), np.sin(self._angles)], 1)
        self._memory: deque[Floats] = deque(maxlen=self.MEMORY_FRAMES)
        self._last = 0.0
        self._turn = 0.0

    def _points(self, depth: NDArray[np.floating], observation: Observation) -> tuple[Floats, Mask]:
        """The nearest point of each second column at the height of flight, (forward, right) in the heading frame.

        With it what there is at the height of flight, at half the size.
        """
        z = np.asarray(depth[::2, ::2], dtype=np.float64)
        rays = observation.frame.camera.rays[::2, ::2]
        finite = np.isfinite(z) & (z < self.HORIZON_M * 1.5)
        points = np.where(finite, z, 0.0)[..., None] * rays @ observation.heading_from_camera.T
        hit = finite & (np.abs(points[..., 2]) < self.BAND_M) & (observation.height_m - points[..., 2] > 0.15)
        distance = np.where(hit, np.hypot(points[..., 0], points[..., 1]), np.inf)
        row = distance.argmin(axis=0)
        columns = np.arange(z.shape[1])
        return points[row, columns, :2][np.isfinite(distance[row, columns])], hit

    def _remembered(self, points: Floats, observation: Observation) -> Floats:
        """The points with those of the last frames, carried along by the odometry; one for each small cell."""
        c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
        to_world = np.array([[c, s], [s, -c]])  # (forward, right) -> (x, y left); its own inverse
        here = observation.displacement_m[:2]
        near = points[np.hypot(points[:, 0], points[:, 1]) < self.MEMORY_M]
        old = np.concatenate([np.empty((0, 2)), *self._memory])
        self._memory.append(near @ to_world + here)
        old = (old - here) @ to_world
        every = np.concatenate([points, old[np.hypot(old[:, 0], old[:, 1]) < self.MEMORY_M]])
        _, first = np.unique(np.floor(every / self.CELL_M).astype(np.int64), axis=0, return_index=True)
        return every[first]

    def _ways(self, velocity: Floats) -> Floats:
        """Where each command leads, (forward, right) at each step [C, STEPS, 2]."""
        speed = np.tile(velocity, (len(self._commands), 1))
        acceleration, place = np.zeros_like(speed), np.zeros_like(speed)
        ways = np.empty((len(speed), self.STEPS, 2))
        for step in range(self.STEPS):
            wanted = self.GAIN_PER_S * (self._commands - speed)
            wanted *= np.minimum(1.0, self.LIMIT_M_S2 / np.maximum(np.hypot(*wanted.T), 1e-9))[:, None]
            acceleration += (wanted - acceleration) * min(1.0, self.STEP_S / self.LAG_S)
            speed = speed + acceleration * self.STEP_S
            place = place + speed * self.STEP_S
            ways[:, step] = place
        return ways

    def _room(self, ways: Floats, points: Floats) -> Floats:
        """The distance from each place on the ways to the nearest point [C, STEPS]."""
        reach = float(np.abs(ways).max()) + 1.0
        forward, right = points[(np.abs(points) < reach).all(axis=1)].T.astype(np.float32)
        along, across = ways.astype(np.float32)[..., None, :].transpose(3, 0, 1, 2)
        square = np.square(along - forward) + np.square(across - right)
        return np.sqrt(square.min(axis=2, initial=np.inf))

    def __call__(self, depth: NDArray[np.floating], observation: Observation) -> Output:
        """``depth``: metres [H, W], infinite or NaN where nothing is known to be."""
        setup = self._setup
        seen, hit = self._points(depth, observation)
        points = self._remembered(seen, observation)
        ways = self._ways(observation.velocity_m_s[:2])
        room = self._room(ways, points)
        # Half the diagonal over the rotors, and a hand's width; where something is nearer already, not nearer still.
        tight = setup.half_width_m * 1.3 + 0.12
        here = float(np.hypot(points[:, 0], points[:, 1]).min(initial=np.inf))
        blocked = room < min(tight, 0.95 * here)
        free = np.where(blocked.any(axis=1), blocked.argmax(axis=1), self.STEPS)  # steps
        until = np.maximum(free - 1, 0)
        goal = float(np.clip(np.arctan2(observation.goal_m[1], observation.goal_m[0]), -1.2, 1.2))
        reached = ways[np.arange(len(ways)), until] @ np.array([np.cos(goal), np.sin(goal)])
        least = np.minimum.accumulate(room, axis=1)[np.arange(len(ways)), until]
        score = (
            reached / (setup.speed_m_s * self.STEP_S * self.STEPS)
            + 0.3 * np.clip((least - tight) / 0.5, 0.0, 1.0)
            + 0.3 * free / self.STEPS
            - 0.12 * np.abs(self._angles - self._last)
        )
        stops = np.minimum(self._speeds / self.STOP_M_S2 + self.STOP_LAG_S, self.STEPS * self.STEP_S)
        admissible = free * self.STEP_S >= stops
        forward, right = 0.0, 0.0
        if admissible.any():
            best = int(np.where(admissible, score, -np.inf).argmax())
            angle = float(self._angles[best])
            forward, right = map(float, self._commands[best])
            self._turn = 0.0
            yaw_rate = 2.5 * angle
        else:
            # Stops and turns, always the same way, until something opens.
            best = int(free.argmax())
            angle = float(self._angles[best])
            self._turn = self._turn or (1.0 if angle >= 0 else -1.0)
            yaw_rate = 1.2 * self._turn
        self._last = angle
        near = hit.repeat(2, axis=0).repeat(2, axis=1)[: depth.shape[0], : depth.shape[1]]
        point = observation.pixel(np.array([np.cos(angle), np.sin(angle), 0.0]))
        return Output(near, point, Command((forward, right, _climb(observation)), yaw_rate))


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
