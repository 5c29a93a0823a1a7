# SPDX-License-Identifier: MIT
"""Ajna in the loop: the skills that the flight program flies (:class:`ajna.tasks.Skill`), on a signal and at a rate.

Here is only what the vehicle of the simulation adds: when is planned, what its sensors say, and an autopilot.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ajna import tasks
from ajna.sim.methods.signals import Signal, Source, TrueMotionSignal
from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.vehicle import CAMERA_AHEAD_M, Command

__all__ = [
    "OUR_VEHICLE",
    "OUR_VEHICLE_BFLOAT16",
    "PAPERS_VEHICLE",
    "Autopilot",
    "FlightTiming",
    "Pace",
    "SkillMethod",
    "Timing",
]

Floats = NDArray[np.float64]


class Pace(Protocol):
    """When is planned, and when the commands that follow hold."""

    def schedule(self, camera_hz: float) -> Iterator[int | None]:
        """For each frame in turn, without end: by how many frames later a command that follows from it holds; None: it
        is not planned on."""

    def averages(self, camera_hz: float) -> tuple[float, float]:
        """(plans a second, mean seconds from a frame to its command), on which a skill counts."""


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
        return every, _frames(self.latency_s, camera_hz)

    def schedule(self, camera_hz: float) -> Iterator[int | None]:
        """See :class:`Pace`; raises as :meth:`in_frames`."""
        every, delay = self.in_frames(camera_hz)
        return itertools.cycle([*[None] * (every - 1), delay])

    def averages(self, camera_hz: float) -> tuple[float, float]:
        """See :class:`Pace`; raises as :meth:`in_frames`."""
        every, delay = self.in_frames(camera_hz)
        return camera_hz / every, delay / camera_hz


@dataclass(frozen=True)
class FlightTiming:
    """When the flight program plans: one frame at a time, the newest there is when it is done with the last.

    pair_s: what a pair of frames takes, as ``ajna_flight`` says at its start. Its command holds from the next frame on
    after that, as the simulation changes commands at frames only: half a frame later on average than ajna::flight::pace
    counts on. The skill's own milliseconds are not counted.
    """

    pair_s: float

    def schedule(self, camera_hz: float) -> Iterator[int | None]:
        """See :class:`Pace`; raises ValueError where ``pair_s`` is not positive."""
        if not self.pair_s > 0:
            raise ValueError(f"time of a pair {self.pair_s} s: give a positive number")
        return self._schedule(camera_hz)

    def _schedule(self, camera_hz: float) -> Iterator[int | None]:
        free_s = 0.0
        for count in itertools.count():
            if free_s * camera_hz >= count + 1 - _SAME:  # by then there is a newer one
                yield None
                continue
            free_s = max(count / camera_hz, free_s) + self.pair_s
            yield _frames(free_s - count / camera_hz, camera_hz)

    def averages(self, camera_hz: float) -> tuple[float, float]:
        """See :class:`Pace`: over the first minute; raises as :meth:`schedule`."""
        frames = round(60 * camera_hz)
        delays = [delay for delay in itertools.islice(self.schedule(camera_hz), frames) if delay is not None]
        return len(delays) * camera_hz / frames, sum(delays) / len(delays) / camera_hz


_SAME = 1e-9  # of a frame: what lies closer together is at the same time


def _frames(duration_s: float, camera_hz: float) -> int:
    return math.ceil(duration_s * camera_hz - _SAME)


#: The paper's vehicle: planning at about 8 Hz on frames of 30 Hz, 49 ms for the network.
PAPERS_VEHICLE = Timing(rate_hz=8.0, latency_s=0.049)

#: Ours: what ``ajna_flight --dry-run`` says of docs/flight.yaml (float32, two threads, 320x240) on two cores of an
#: Intel Xeon with AMX; and the same with ``model.bfloat16``.
OUR_VEHICLE = FlightTiming(pair_s=0.043)
OUR_VEHICLE_BFLOAT16 = FlightTiming(pair_s=0.017)

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

    def __init__(self, name: str, signal: Signal, timing: Pace | None = None) -> None:
        self.name = name
        self.needs: frozenset[str] = signal.needs
        self._signal = signal
        self._timing: Pace = timing or Timing()

    def on_true_motion(self) -> SkillMethod:
        """The same skill at the same times, on maps that tell the truth: for navigating."""
        return SkillMethod(f"{self.name} on true motion", TrueMotionSignal(), self._timing)

    def reset(self, setup: TaskSetup) -> None:
        """Start a trial."""
        self.needs = self._signal.needs
        if setup.task in ("gap", "pile"):
            self.needs = self.needs | {"rgb"}  # gaps are tracked and piles are outlined in the pictures
        source = self._signal.source(setup.camera)
        self._schedule = self._timing.schedule(setup.camera.rate_hz)
        self._skill: tasks.Skill | PileSkill
        if setup.task == "pile":
            self._skill = PileSkill(source)
        else:
            options = skill_options(setup, *self._timing.averages(setup.camera.rate_hz))
            self._signal.adapt(options)
            self._skill = tasks.Skill(options, source)
        self._autopilot = Autopilot()
        self._pending: deque[tuple[int, tasks.Command]] = deque()
        self._command: tasks.Command | None = None
        self._count = 0

    def __call__(self, observation: Observation) -> Output:
        count, self._count = self._count, self._count + 1
        if isinstance(self._skill, PileSkill):
            return self._skill(observation)
        delay = next(self._schedule)
        output = Output(planned=delay is not None)
        if delay is not None:
            answer = self._skill.plan(
                **self._seen(observation),
                velocity_m_s=observation.velocity_m_s,
                goal=observation.goal_m,
                too_high_m=observation.height_m - observation.hold_height_m,
            )
            if answer.valid:
                self._pending.append((count + delay, answer.command))
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
