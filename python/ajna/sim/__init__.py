# SPDX-License-Identifier: MIT
# ruff: noqa: E402 (what fails without MuJoCo comes after the sentence that says so)
"""Simulated worlds for the paper's closed-loop experiments: MuJoCo physics, a rendered camera, a quadrotor, and trials.

Needs the extra ``sim`` (``pip install "ajna[sim]"``) and, for pictures and depth, EGL or OSMesa software rendering.
World frame: x in the direction of the goal, y left, z up (metres). Body and command frames: forward, right, down.
Camera: optical frame x right, y down, z forward.
"""


class MissingSimulatorError(ImportError, RuntimeError):
    """MuJoCo is not installed."""


try:
    import mujoco  # noqa: F401
except ImportError as _error:
    raise MissingSimulatorError(
        f'the simulator needs MuJoCo, which cannot be imported ({_error}); install it with: pip install "ajna[sim]"'
    ) from _error

from ajna.sim.camera import CameraModel, Frame
from ajna.sim.episode import EpisodeResult, run_episode
from ajna.sim.methods import METHODS, make_method
from ajna.sim.truth import occlusion_and_flow, warp
from ajna.sim.vehicle import Command, VehicleConfig
from ajna.sim.worlds import WORLDS, World, make_world

__all__ = [
    "METHODS",
    "WORLDS",
    "CameraModel",
    "Command",
    "EpisodeResult",
    "Frame",
    "MissingSimulatorError",
    "VehicleConfig",
    "World",
    "make_method",
    "make_world",
    "occlusion_and_flow",
    "run_episode",
    "warp",
]
