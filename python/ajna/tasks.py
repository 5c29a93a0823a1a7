# SPDX-License-Identifier: MIT
"""Four robot skills from uncertainty alone (the C++ libraries ``tasks``, ``control``, ``skills`` and ``geometry``).

    from ajna import tasks

    pipeline, policy = tasks.DodgePipeline(), tasks.DodgePolicy()
    result = pipeline.step(field.uncertainty, time_s)  # what is there, and where
    command = policy.update(result.safe_direction, time_s)  # what to do about it

Pipelines turn maps of uncertainty into masks, regions, points and directions, policies turn those into commands. Every
result has a ``status``; what a pipeline cannot know it says, and leaves out. :class:`Skill` puts signal, pipeline and
policy of one task together, as the flight program and the simulation fly them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import _core

if not _core.with_vision:
    raise ImportError("ajna.tasks needs the build with vision: build ajna again with AJNA_WITH_VISION=ON")

from ajna._core import (
    Alignment,
    AlignOptions,
    BackgroundOptions,
    Camera,
    CloserLookOptions,
    Command,
    CorridorOptions,
    DodgeOptions,
    DodgePipeline,
    DodgePolicy,
    DodgePolicyOptions,
    DodgeResult,
    ExploreOptions,
    FitOptions,
    GapDetection,
    GapDetectionOptions,
    GapOptions,
    GapPipeline,
    GapPolicy,
    GapPolicyOptions,
    GapResult,
    GapTrackerOptions,
    Guidance,
    HorizonOptions,
    MapOptions,
    MapSteps,
    NavigateOptions,
    NavigatePipeline,
    NavigatePolicy,
    NavigatePolicyOptions,
    NavigateResult,
    NetworkSignal,
    OccupancyOptions,
    Pid,
    PidOptions,
    SegmentOptions,
    SegmentResult,
    Skill,
    SkillOptions,
    SkillOutput,
    Snapshot,
    align_to,
    derotate_flow,
    derotate_frame,
    derotate_pixel,
    desired_direction,
    detect_gap,
    explore,
    find_regions,
    fit_expansion,
    focus_of_expansion,
    horizon_obstacles,
    largest_free_space,
    motion_field,
    navigation_weight,
    rotate_pixel,
    segment_pile,
)

__all__ = [
    "SKILLS",
    "AlignOptions",
    "Alignment",
    "BackgroundOptions",
    "Camera",
    "CloserLookOptions",
    "Command",
    "CorridorOptions",
    "DodgeOptions",
    "DodgePipeline",
    "DodgePolicy",
    "DodgePolicyOptions",
    "DodgeResult",
    "ExploreOptions",
    "FitOptions",
    "GapDetection",
    "GapDetectionOptions",
    "GapOptions",
    "GapPipeline",
    "GapPolicy",
    "GapPolicyOptions",
    "GapResult",
    "GapTrackerOptions",
    "Guidance",
    "HorizonOptions",
    "MapOptions",
    "MapSteps",
    "NavigateOptions",
    "NavigatePipeline",
    "NavigatePolicy",
    "NavigatePolicyOptions",
    "NavigateResult",
    "NetworkSignal",
    "OccupancyOptions",
    "Pid",
    "PidOptions",
    "SegmentOptions",
    "SegmentResult",
    "Skill",
    "SkillOptions",
    "SkillOutput",
    "Snapshot",
    "align_to",
    "command_dict",
    "derotate_flow",
    "derotate_frame",
    "derotate_pixel",
    "desired_direction",
    "detect_gap",
    "explore",
    "find_regions",
    "fit_expansion",
    "focus_of_expansion",
    "guidance",
    "horizon_obstacles",
    "largest_free_space",
    "motion_field",
    "navigation_weight",
    "rotate_pixel",
    "segment_pile",
]

#: What a robot can do here, by the names of the command line.
SKILLS = ("dodge", "navigate", "gap", "segment")


def guidance(result: NavigateResult) -> Guidance | None:
    """What :class:`NavigatePolicy` takes from a frame: nothing where the frame had no answer."""
    if result.status != "ok":
        return None
    return Guidance(result.goal_direction, result.free_direction, result.weight)


def command_dict(command: Command) -> dict[str, Any]:
    """A command as plain JSON values."""
    return {
        "mode": command.mode,
        "velocity_m_s": _rounded(command.velocity_m_s),
        "acceleration_m_s2": _rounded(command.acceleration_m_s2),
        "yaw_rate_rad_s": round(float(command.yaw_rate_rad_s), 6),
    }


def _rounded(vector: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 6) for value in vector]
