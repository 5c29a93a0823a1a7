# SPDX-License-Identifier: MIT
"""Ajna in the loop: uncertainty map, pipeline of :mod:`ajna.tasks`, control policy; nothing of the reference pilots.

Pairs are taken backwards in time, from the new frame to an older one: maps then lie on the picture that the vehicle has
before it now. Only the gap's stacked maps lie on an older one, the frame that the exploratory motion began with.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ajna import tasks
from ajna.sim.methods.signals import Signal
from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.vehicle import Command

__all__ = ["PAPERS_VEHICLE", "SkillMethod", "Timing"]

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


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

PAST_FRAMES = 8  # that are kept


@dataclass
class Answer:
    """What planning on one frame gave; see :class:`ajna.sim.observation.Output`. command: None leaves the last one."""

    mask: Mask | None = None
    point_px: tuple[float, float] | None = None
    command: tasks.Command | Command | None = None
    decided: bool = False


class Skill(Protocol):
    """A pipeline with its policy for one trial. ``past``: the frames before this one, latest last; at first none."""

    def plan(self, observation: Observation, past: Sequence[Observation]) -> Answer: ...


class SkillMethod:
    """A signal, a pipeline and a policy as a method of the simulation.

    Args:
        name: of the method; signal: where the maps come from; timing: when is planned.
    """

    tasks = frozenset({"navigate", "gap", "dodge", "pile"})

    def __init__(self, name: str, signal: Signal, timing: Timing | None = None) -> None:
        self.name = name
        self.needs: frozenset[str] = signal.needs
        self._signal = signal
        self._timing = timing or Timing()

    def reset(self, setup: TaskSetup) -> None:
        """Start a trial."""
        if setup.task in ("gap", "pile"):
            self.needs = self._signal.needs | {"rgb"}  # gaps are tracked and piles are outlined in the pictures
        self._every, self._delay = (1, 0) if setup.task == "pile" else self._timing.in_frames(setup.camera.rate_hz)
        skills: dict[str, Callable[[Signal, TaskSetup, int], Skill]] = {
            "navigate": NavigateSkill,
            "gap": GapSkill,
            "dodge": DodgeSkill,
            "pile": PileSkill,
        }
        self._skill = skills[setup.task](self._signal, setup, self._every)
        self._autopilot = Autopilot()
        self._past: deque[Observation] = deque(maxlen=PAST_FRAMES)
        self._pending: deque[tuple[int, tasks.Command | Command]] = deque()
        self._command: tasks.Command | Command | None = None
        self._count = 0

    def __call__(self, observation: Observation) -> Output:
        count, self._count = self._count, self._count + 1
        answer = Answer()
        planned = (count + 1) % self._every == 0
        if planned:
            answer = self._skill.plan(observation, self._past)
            if answer.command is not None:
                self._pending.append((count + self._delay, answer.command))
        self._past.append(observation)
        while self._pending and self._pending[0][0] <= count:
            self._command = self._pending.popleft()[1]
        command = self._autopilot(self._command, observation)
        return Output(answer.mask, answer.point_px, command, answer.decided, planned)


class Autopilot:
    """Turns commands of the policies into the vehicle's, and holds the position where they say hold (or nothing)."""

    GAIN_PER_S = 1.5
    STOPPED_M_S = 0.5  # a hold brakes to this speed, then keeps the place it has reached

    def __init__(self) -> None:
        self._anchor: Floats | None = None

    def __call__(self, command: tasks.Command | Command | None, observation: Observation) -> Command:
        if isinstance(command, Command):
            self._anchor = None
            return command
        if command is None or command.mode == "hold":
            return Command(self._hold(observation))
        self._anchor = None
        if command.mode == "acceleration":
            forward, right, down = (float(v) for v in command.thrust_m_s2)
            return Command(None, float(command.yaw_rate_rad_s), (forward, right, down))
        forward, right, down = (float(v) for v in command.velocity_m_s)
        return Command((forward, right, down), float(command.yaw_rate_rad_s))

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


def _camera_frd(observation: Observation, direction: Floats) -> Floats:
    """A direction in the heading frame, along the axes of the camera: forward, right, down."""
    right, down, forward = observation.heading_from_camera.T @ direction
    return np.array([forward, right, down])


def _heading_frd(observation: Observation, direction: Floats) -> Floats:
    """The inverse of :func:`_camera_frd`."""
    forward, right, down = direction
    return observation.heading_from_camera @ np.array([right, down, forward])


class DodgeSkill:
    """Hover until something comes; see :class:`ajna.tasks.DodgePipeline`."""

    def __init__(self, signal: Signal, setup: TaskSetup, every: int) -> None:
        options = tasks.DodgeOptions()
        options.horizontal_fov_rad = setup.camera.horizontal_fov_rad
        options.max_gap_s = max(options.max_gap_s, 2.5 * every / setup.camera.rate_hz)
        self._signal = signal
        self._pipeline, self._policy = tasks.DodgePipeline(options), tasks.DodgePolicy()
        self._decided = False

    def plan(self, observation: Observation, past: Sequence[Observation]) -> Answer:
        if not past:
            return Answer()
        time_s = observation.frame.time_s
        result = self._pipeline.step(self._signal(observation, past[-1]), time_s)
        command = self._policy.update(result.safe_direction, time_s)
        decided = not self._decided and self._policy.dodging
        self._decided |= decided
        seen = result.track[-1].center_px if result.mask is not None else None
        return Answer(result.mask, None if seen is None else (float(seen[0]), float(seen[1])), command, decided)


class NavigateSkill:
    """Fly to the goal through what is free; see :class:`ajna.tasks.NavigatePipeline`.

    Pairs span a tenth of a second, so that what is near has moved by some pixels, and the turning between them is taken
    out: what is left grows with inverse depth.

    The altimeter holds the height: of the directions only the horizontal part is followed.
    """

    HEIGHT_GAIN = 0.4  # of the direction's downward part, per metre too high
    LARGEST_SLOPE = 0.3
    BASELINE_S = 0.1

    def __init__(self, signal: Signal, setup: TaskSetup, every: int) -> None:
        options, policy = tasks.NavigateOptions(), tasks.NavigatePolicyOptions()
        options.horizontal_fov_rad = setup.camera.horizontal_fov_rad
        policy.speed_m_s = setup.speed_m_s
        self._signal = signal
        self._pipeline, self._policy = tasks.NavigatePipeline(options), tasks.NavigatePolicy(policy)
        self._baseline = max(1, round(self.BASELINE_S * setup.camera.rate_hz))  # frames

    def _level(self, direction: Floats, observation: Observation) -> Floats:
        level = np.array([direction[0], direction[1], 0.0])
        level /= max(float(np.linalg.norm(level)), 1e-9)
        too_high = observation.height_m - observation.hold_height_m
        level[2] = np.clip(self.HEIGHT_GAIN * too_high, -self.LARGEST_SLOPE, self.LARGEST_SLOPE)
        return level

    def plan(self, observation: Observation, past: Sequence[Observation]) -> Answer:
        time_s = observation.frame.time_s
        goal = self._level(observation.goal_m, observation)
        if not past:
            guidance = tasks.Guidance(goal, goal, 0.0)  # take off towards the goal: without motion there is no map
            return Answer(command=self._policy.update(guidance, time_s, observation.velocity_m_s))
        older = past[-min(self._baseline, len(past))]
        uncertainty = self._signal(observation, older, "rotation")
        result = self._pipeline.step(uncertainty, time_s, _camera_frd(observation, goal))
        point, found = None, None
        if result.status == "ok":
            free = self._level(_heading_frd(observation, result.free_direction), observation)
            found = tasks.Guidance(goal, free, result.weight)
            point = observation.pixel(tasks.desired_direction(found))
        command = self._policy.update(found, time_s, observation.velocity_m_s)
        mask = result.steps.mask
        return Answer(mask, point, command)


class GapSkill:
    """Explore, find the gap, fly through it; see :class:`ajna.tasks.GapPipeline`.

    The vehicle begins at rest. What the pipeline tracks are frames from which roll and pitch, which the IMU knows, are
    taken out. Where no gap is found, or it is lost, it stops and explores anew, each time the other way.
    """

    SETTLE_S = 0.3
    REST_M_S, REST_RAD = 0.15, 0.05  # what counts as at rest and level
    LOOK_S = (0.4, 0.8)  # of exploring before the first look at the stacked maps, and before it starts anew
    COAST_S = 2.0  # after the gap surrounds the camera: the length of the vehicle, and room to stop
    SLEW_M_S2 = 2.0  # change of the velocity asked for: what is harder tilts the camera, and blurs

    def __init__(self, signal: Signal, setup: TaskSetup, every: int) -> None:
        options, policy = tasks.GapOptions(), tasks.GapPolicyOptions()
        policy.coast_duration_s = self.COAST_S
        policy.forward_m_s = policy.coast_m_s = setup.speed_m_s
        planning_hz = setup.camera.rate_hz / every
        least, most = (max(3, round(seconds * planning_hz)) for seconds in self.LOOK_S)
        options.min_pairs, options.max_pairs = least, max(most, least + 3)
        self._step_m_s = self.SLEW_M_S2 / planning_hz
        self._fov_rad = setup.camera.horizontal_fov_rad
        self._signal = signal
        self._pipeline = tasks.GapPipeline(options, self._fov_rad)
        self._policy = tasks.GapPolicy(policy)
        self._explore = tasks.ExploreOptions()
        self._explore.duration_s = 2 * self.LOOK_S[1]  # until the pipeline says that it has seen enough
        self._reference: Observation | None = None
        self._velocity = np.zeros(3)
        self._began_s = 0.0
        self._rounds = 0
        self._decided = False

    def plan(self, observation: Observation, past: Sequence[Observation]) -> Answer:
        time_s = observation.frame.time_s
        level = _level_from_camera(observation)
        if self._reference is None:
            speed, tilt = float(np.linalg.norm(observation.velocity_m_s)), math.acos(min(1.0, float(level[2, 2])))
            if time_s < self.SETTLE_S or speed > self.REST_M_S or tilt > self.REST_RAD:
                return Answer(command=self._toward(np.zeros(3)))
            self._start(observation)
            self._pipeline.reset()
            self._policy.reset()
            self._pipeline.step(observation.rgb, None, time_s)
            return Answer(command=self._wobble(0.0))
        stable = tasks.derotate_frame(observation.rgb, level, self._fov_rad)
        uncertainty = self._signal(self._reference, observation, "plane") if self._pipeline.wants_map else None
        result = self._pipeline.step(stable.image, uncertainty, time_s)
        if result.status == "exploring":
            return Answer(command=self._wobble(time_s - self._began_s))
        if result.status == "through":
            return Answer(command=self._follow(self._policy.update(None, True, time_s)))
        if result.status != "tracking":
            self._reference = None
            return Answer(command=self._toward(np.zeros(3)))
        command = self._policy.update(result.safe_offset, False, time_s)
        decided, self._decided = not self._decided, True
        back = np.linalg.inv(stable.reference_from_frame)
        contour = _mapped(back, result.contour)
        point = _mapped(back, result.safe_px[None])[0]
        return Answer(_inside(contour, observation), (float(point[0]), float(point[1])), self._follow(command), decided)

    def _start(self, observation: Observation) -> None:
        self._reference, self._began_s = observation, observation.frame.time_s
        self._rounds += 1

    def _toward(self, velocity: Floats) -> Command:
        """A velocity in steps that do not tilt the camera much."""
        change = velocity - self._velocity
        self._velocity = self._velocity + change * min(1.0, self._step_m_s / max(float(np.linalg.norm(change)), 1e-9))
        forward, right, down = (float(v) for v in self._velocity)
        return Command((forward, right, down))

    def _follow(self, command: tasks.Command) -> Command:
        return self._toward(np.array(command.velocity_m_s))

    def _wobble(self, elapsed_s: float) -> Command:
        way = 1.0 if self._rounds % 2 else -1.0
        return self._toward(way * np.array(tasks.explore(self._explore, elapsed_s).velocity_m_s))


class PileSkill:
    """Outline the pile on the second of two views, the table being at rest; see :func:`ajna.tasks.segment_pile`."""

    def __init__(self, signal: Signal, setup: TaskSetup, every: int) -> None:
        self._signal = signal

    def plan(self, observation: Observation, past: Sequence[Observation]) -> Answer:
        if not past:
            return Answer()
        result = tasks.segment_pile(observation.rgb, self._signal(observation, past[-1], "plane"))
        return Answer(result.segmentation, decided=result.status == "ok")


def _level_from_camera(observation: Observation) -> Floats:
    """From the camera's axes to those of a camera that is level and looks ahead (x right, y down, z forward) [3, 3]."""
    return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) @ observation.heading_from_camera


def _mapped(homography: NDArray[np.floating], points: NDArray[np.floating]) -> Floats:
    """Points [N, 2] by a homography."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def _inside(contour: NDArray[np.floating], observation: Observation) -> Mask:
    """The pixels inside a closed contour [N, 2], bool [H, W]."""
    import cv2

    camera = observation.frame.camera
    mask = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillPoly(mask, [np.rint(np.asarray(contour)).astype(np.int32)], 1)
    return mask.astype(bool)
