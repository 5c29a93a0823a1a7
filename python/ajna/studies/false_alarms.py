# SPDX-License-Identifier: MIT
"""How often a hovering vehicle dodges nothing: rooms without a throw, at rest and under blinking light."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import tasks
from ajna.bootstrap import bootstrap_interval
from ajna.sim.flight import Flight
from ajna.sim.methods.signals import Signal
from ajna.sim.methods.skills import Autopilot, skill_options
from ajna.sim.observation import Observation, TaskSetup
from ajna.sim.render import Renderer
from ajna.sim.vehicle import Command
from ajna.sim.worlds import DodgeSetup, World, make_world

__all__ = ["CONDITIONS", "Condition", "FalseAlarmOptions", "markdown", "run"]

Frame = NDArray[np.uint8]
Disturbance = Callable[[Frame, float, np.random.Generator], Frame]


@dataclass(frozen=True)
class FalseAlarmOptions:
    """``rooms`` of the dodging world from seed ``seed`` on, watched for ``duration_s`` each."""

    rooms: int = 20
    seed: int = 0
    duration_s: float = 2.0


@dataclass
class Condition:
    """What was counted under one light: rooms in which a dodge began, and frames on which something stood out."""

    name: str
    alarms: list[bool] = field(default_factory=list)
    detections: list[float] = field(default_factory=list)  # share of the frames, one per room

    def record(self) -> dict[str, Any]:
        """Rates with 95 % bootstrap intervals over the rooms."""
        result: dict[str, Any] = {"name": self.name, "rooms": len(self.alarms)}
        for key, values in (("false_alarm_rate", self.alarms), ("detected_frames", self.detections)):
            numbers = np.asarray(values, float)
            result[key] = float(numbers.mean())
            result[f"{key}_ci"] = bootstrap_interval(numbers)
        return result


def _square(time_s: float, period_s: float) -> bool:
    return (time_s / period_s) % 1.0 < 0.5


def _room_light(frame: Frame, time_s: float, random: np.random.Generator) -> Frame:
    """All light falls to 60 % and comes back, once to five times a second."""
    period = random.uniform(0.2, 1.0)
    return frame if _square(time_s, period) else np.rint(frame * 0.6).astype(np.uint8)


def _lamp(frame: Frame, time_s: float, random: np.random.Generator) -> Frame:
    """A lamp of 3 to 8 % of the picture's height goes on and off, once to five times a second."""
    height, width = frame.shape[:2]
    period = random.uniform(0.2, 1.0)
    x, y = random.uniform([0.15 * width, 0.15 * height], [0.85 * width, 0.85 * height])
    radius, color = random.uniform(0.03, 0.08) * height, random.uniform(180, 255, 3)
    if not _square(time_s, period):
        return frame
    rows, columns = np.mgrid[:height, :width]
    glow = np.clip((1.33 * radius - np.hypot(columns - x, rows - y)) / (0.33 * radius), 0, 1)[..., None]
    return np.rint(frame + glow * np.maximum(color - frame, 0)).astype(np.uint8)


def _exposure(frame: Frame, time_s: float, random: np.random.Generator) -> Frame:
    """The exposure jumps by a stop, up or down, at one moment between a half and one and a half seconds."""
    moment, gain = random.uniform(0.5, 1.5), random.choice([0.5, 2.0])
    return frame if time_s < moment else np.clip(np.rint(frame * gain), 0, 255).astype(np.uint8)


#: Light -> what it does to a frame at a time; the generator is the same for all frames of a room.
CONDITIONS: dict[str, Disturbance] = {
    "steady light": lambda frame, time_s, random: frame,
    "room light blinks": _room_light,
    "a lamp blinks": _lamp,
    "exposure jumps": _exposure,
}


def _hover(world: World, duration_s: float) -> Iterator[Observation]:
    """What the hovering vehicle sees of a room in which nothing is thrown, with its pictures rendered."""
    assert isinstance(world.setup, DodgeSetup)
    quiet = dataclasses.replace(world, setup=dataclasses.replace(world.setup, launch_s=float("inf")))
    autopilot = Autopilot()
    with Renderer(quiet.model, quiet.camera) as renderer:
        flight = Flight(quiet, renderer, quiet.seed)
        command = Command()
        for _ in range(round(duration_s * quiet.camera.rate_hz)):
            frame = flight.advance(command)
            observation = flight.observe(frame)
            _ = frame.rgb, frame.depth  # rendered while there is a renderer
            command = autopilot(None, observation)
            yield observation


def run(
    signal: Signal,
    options: FalseAlarmOptions,
    make: Callable[[int], World] | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Condition]:
    """Watch every room under every light.

    Args:
        signal: where the maps come from, as in :mod:`ajna.sim.methods`.
        make: the room of a seed; by default the dodging world's.

    Raises:
        ValueError: no rooms, or no time; NoRenderingError: nothing can be rendered here.
    """
    if options.rooms < 1 or not options.duration_s > 0:
        raise ValueError(f"{options.rooms} rooms for {options.duration_s} s: give at least one, and a positive time")
    conditions = [Condition(name) for name in CONDITIONS]
    for room in range(options.rooms):
        seed = options.seed + room
        world = make(seed) if make is not None else make_world("dodge", seed)
        seen = list(_hover(world, options.duration_s))
        setup = TaskSetup("dodge", world.camera, 0.0, world.vehicle.half_width_m, seed)
        for condition in conditions:
            _watch(condition, signal, setup, seen)
        if progress is not None:
            progress((room + 1) / options.rooms)
    return conditions


def _watch(condition: Condition, signal: Signal, setup: TaskSetup, seen: list[Observation]) -> None:
    chosen = skill_options(setup, setup.camera.rate_hz)
    signal.adapt(chosen)
    skill = tasks.Skill(chosen, signal.source(setup.camera))
    disturb = CONDITIONS[condition.name]
    alarm, detected = False, 0
    for observation in seen:
        time_s = observation.frame.time_s
        frame = disturb(observation.rgb, time_s, np.random.default_rng([setup.seed, 0xB11]))
        output = skill.plan(time_s, frame, observation.heading_from_camera, -observation.yaw_rad, tag=observation)
        alarm = alarm or output.decided
        detected += output.mask is not None
    condition.alarms.append(alarm)
    condition.detections.append(detected / max(len(seen), 1))


def markdown(conditions: list[Condition], options: FalseAlarmOptions) -> str:
    """A table: rates in percent with their intervals."""
    head = f"light ({options.rooms} rooms, {options.duration_s:g} s each)"
    lines = [
        f"| {head} | rooms with a dodge, % | frames with a detection, % |",
        "|---|---|---|",
    ]
    for condition in conditions:
        record = condition.record()
        cells = [
            f"{100 * record[key]:.0f} [{100 * record[f'{key}_ci'][0]:.0f}, {100 * record[f'{key}_ci'][1]:.0f}]"
            for key in ("false_alarm_rate", "detected_frames")
        ]
        lines.append(f"| {condition.name} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)
