# SPDX-License-Identifier: MIT
"""Ajna in the loop: the skills that the flight program flies (:class:`ajna.tasks.Skill`), on a signal and at a rate.

Here is only what the vehicle of the simulation adds: when is planned, what its sensors say, and an autopilot.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import tasks
from ajna.sim.methods.signals import Signal, Source, TrueMotionSignal
from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.vehicle import CAMERA_AHEAD_M, Command

__all__ = ["PAPERS_VEHICLE", "Autopilot", "SkillMethod", "Timing"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Timing:
    """How often is planned, and how long an answer takes.

    rate_hz: of planning; None: on every frame. latency_s: from a frame to the command that follows from it; 0: the
    command is there before the next frame.
    """

    rate_hz: float | None = None
    latency_s: float = 0.0

    def in_frames(self, camera_hz: float) -> tuple[int, int]:
        """(plan on every n-th frame, the answer holds m frames later).

        Raises:
            ValueError: a rate that is not positive, or a negative latency.
        """
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise ValueError(f"planning rate {self.rate_hz} Hz: give a positive number")
        if not self.latency_s >= 0:
            raise ValueError(f"latency {self.latency_s} s: give 0 or more")
        every = 1 if self.rate_hz is None else max(1, round(camera_hz / self.rate_hz))
        return every, math.ceil(self.latency_s * camera_hz - 1e-9)


#: The paper's vehicle: planning at about 8 Hz on frames of 30 Hz, 49 ms for the network.
PAPERS_VEHICLE = Timing(rate_hz=8.0, latency_s=0.049)

# What the simulated vehicle needs otherwise than by default: its length, and room to stop, after the gap surrounds it.
COAST_S = 2.0


def skill_options(setup: TaskSetup, planning_rate_hz: float, latency_s: float = 0.0) -> tasks.SkillOptions:
    """The options of the skill for a task of the simulation ("dodge", "navigate" or "gap")."""
    options = tasks.SkillOptions()
    options.task = setup.task
    options.horizontal_fov_rad = setup.camera.horizontal_fov_rad
    options.planning_rate_hz = planning_rate_hz
    options.latency_s = latency_s
    if setup.task == "navigate":
        options.navigate_policy.speed_m_s = setup.speed_m_s
        options.corridor.camera_ahead_m = CAMERA_AHEAD_M
    if setup.task == "gap":
        options.gap_policy.coast_duration_s = COAST_S
        options.gap_policy.forward_m_s = options.gap_policy.coast_m_s = setup.speed_m_s
    return options


class SkillMethod:
    """A signal and a skill as a method of the simulation.

    Args:
        name: of the method; signal: where the maps come from; timing: when is planned.
    """

    tasks = frozenset({"navigate", "gap", "dodge", "pile"})

    def __init__(self, name: str, signal: Signal, timing: Timing | None = None) -> None:
        self.name = name
        self.needs: frozenset[str] = signal.needs
        self._signal = signal
        self._timing = timing or Timing()

    def on_true_motion(self) -> SkillMethod:
        """The same skill at the same times, on maps that tell the truth: for navigating."""
        return SkillMethod(f"{self.name} on true motion", TrueMotionSignal(), self._timing)

    def reset(self, setup: TaskSetup) -> None:
        """Start a trial."""
        self.needs = self._signal.needs
        if setup.task in ("gap", "pile"):
            self.needs = self.needs | {"rgb"}  # gaps are tracked and piles are outlined in the pictures
        source = self._signal.source(setup.camera)
        self._every, self._delay = (1, 0) if setup.task == "pile" else self._timing.in_frames(setup.camera.rate_hz)
        self._skill: tasks.Skill | PileSkill
        if setup.task == "pile":
            self._skill = PileSkill(source)
        else:
            options = skill_options(setup, setup.camera.rate_hz / self._every, self._delay / setup.camera.rate_hz)
            self._signal.adapt(options)
            self._skill = tasks.Skill(options, source)
        self._autopilot = Autopilot()
        self._pending: deque[tuple[int, tasks.Command]] = deque()
        self._command: tasks.Command | None = None
        self._count = 0

    def __call__(self, observation: Observation) -> Output:
        count, self._count = self._count, self._count + 1
        output = Output(planned=(count + 1) % self._every == 0)
        if isinstance(self._skill, PileSkill):
            return self._skill(observation)
        if output.planned:
            answer = self._skill.plan(
                **self._seen(observation),
                velocity_m_s=observation.velocity_m_s,
                goal=observation.goal_m,
                too_high_m=observation.height_m - observation.hold_height_m,
            )
            if answer.valid:
                self._pending.append((count + self._delay, answer.command))
            output.mask, output.decided = answer.mask, answer.decided
            closer = self._skill.outline()
            output.mask = answer.mask if closer is None else closer
            if answer.point_px is not None:
                output.point_px = (float(answer.point_px[0]), float(answer.point_px[1]))
        else:
            self._skill.remember(**self._seen(observation))
        while self._pending and self._pending[0][0] <= count:
            self._command = self._pending.popleft()[1]
        output.command = self._autopilot(vehicle_command(self._command), observation)
        return output

    def _seen(self, observation: Observation) -> dict[str, Any]:
        """What the skill is told of a frame. Yaw: to the right there, to the left in the simulation's world."""
        return {
            "time_s": observation.frame.time_s,
            "frame": observation.rgb if "rgb" in self.needs else None,
            "heading_from_camera": observation.heading_from_camera,
            "yaw_rad": -observation.yaw_rad,
            "tag": observation,
        }


def vehicle_command(command: tasks.Command | None) -> Command | None:
    """A policy's command as the simulated vehicle takes it; None where it says hold (or nothing)."""
    if command is None or command.mode == "hold":
        return None
    if command.mode == "acceleration":
        forward, right, down = (float(v) for v in command.thrust_m_s2)
        return Command(None, float(command.yaw_rate_rad_s), (forward, right, down))
    forward, right, down = (float(v) for v in command.velocity_m_s)
    return Command((forward, right, down), float(command.yaw_rate_rad_s))


class Autopilot:
    """Passes commands on, and holds the position where there is none."""

    GAIN_PER_S = 1.5
    STOPPED_M_S = 0.5  # a hold brakes to this speed, then keeps the place it has reached

    def __init__(self) -> None:
        self._anchor: Floats | None = None

    def __call__(self, command: Command | None, observation: Observation) -> Command:
        if command is None:
            return Command(self._hold(observation))
        self._anchor = None
        return command

    def _hold(self, observation: Observation) -> tuple[float, float, float]:
        if self._anchor is None and float(np.linalg.norm(observation.velocity_m_s)) > self.STOPPED_M_S:
            return 0.0, 0.0, 0.0
        if self._anchor is None:
            self._anchor = np.array(observation.displacement_m)
        away = observation.displacement_m - self._anchor
        c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
        back = -self.GAIN_PER_S * np.array([c * away[0] + s * away[1], s * away[0] - c * away[1], -away[2]])
        forward, right, down = (float(v) for v in np.clip(back, -1.5, 1.5))
        return forward, right, down


class PileSkill:
    """Outline the pile on the second of two views, the table being at rest; see :func:`ajna.tasks.segment_pile`."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._before: tasks.Snapshot | None = None

    def __call__(self, observation: Observation) -> Output:
        before, self._before = self._before, tasks.Snapshot(observation.frame.time_s, observation.rgb, tag=observation)
        if before is None:
            return Output()
        result = tasks.segment_pile(observation.rgb, self._source(self._before, before, "plane"))
        return Output(result.segmentation, decided=result.status == "ok")
