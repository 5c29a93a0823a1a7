# SPDX-License-Identifier: MIT
"""The reference methods, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ajna import _core
from ajna.sim.methods.adapter import InstanceMasks, MonocularDepth, Network
from ajna.sim.methods.base import Perception, PilotedMethod
from ajna.sim.methods.blind import Blind
from ajna.sim.methods.depth import D435iSensor, DepthPerception, StereoSensor, TrueDepthSensor
from ajna.sim.methods.events import EventPerception
from ajna.sim.methods.flow import GapFlyt, OcclusionMask

__all__ = ["METHODS", "MethodInfo", "make_method"]


@dataclass(frozen=True)
class MethodInfo:
    """A method's name in the paper, what it does, and how to make what it sees with.

    ``needs_weights``: ``make`` takes a :class:`Network` of the user's.
    """

    title: str
    tasks: frozenset[str]
    make: Callable[..., Perception]
    needs_weights: bool = False


_ALL = frozenset({"navigate", "gap", "dodge", "pile"})
METHODS: dict[str, MethodInfo] = {
    "depth": MethodInfo("true depth", _ALL, lambda: DepthPerception(TrueDepthSensor)),
    "d435i": MethodInfo("D435i (model)", _ALL, lambda: DepthPerception(D435iSensor)),
    "morpheyes": MethodInfo("MorphEyes (SGBM)", _ALL, lambda: DepthPerception(StereoSensor)),
    "occmask": MethodInfo("OccMask (DIS, forward-backward)", OcclusionMask.tasks, OcclusionMask),
    "gapflyt": MethodInfo("GapFlyt (DIS)", GapFlyt.tasks, GapFlyt),
    "events": MethodInfo("event density", EventPerception.tasks, EventPerception),
    "evdodgenet": MethodInfo("EVDodgeNet (SegNet)", EventPerception.tasks, EventPerception, True),
    "midas": MethodInfo("MiDaS", _ALL, MonocularDepth, True),
    "midas-s": MethodInfo("MiDaS-S", _ALL, MonocularDepth, True),
    "mask-rcnn": MethodInfo("Mask R-CNN", InstanceMasks.tasks, InstanceMasks, True),
    "pointrend": MethodInfo("PointRend", InstanceMasks.tasks, InstanceMasks, True),
    "blind": MethodInfo("none (flies straight, hovers)", _ALL, Blind),
}


def make_method(name: str, weights: str | Path | None = None, size: tuple[int, int] | None = None) -> Any:
    """A method by name. ``weights``, ``size``: file and (height, width) of the network of a method that takes one.

    Raises:
        ValueError: an unknown name (the nearest is named), weights missing, or given where none are used.
        FileNotFoundError: no such file.
    """
    if name not in METHODS:
        near = _core.nearest_name(name, list(METHODS))
        hint = f"did you mean '{near}'? " if near else ""
        raise ValueError(f"unknown method '{name}'; {hint}Known: {', '.join(METHODS)}")
    info = METHODS[name]
    if info.needs_weights:
        if weights is None:
            raise ValueError(f"method '{name}' needs a network: give its TorchScript or ONNX file by --weights FILE")
        return PilotedMethod(name, info.make(Network(weights, size)))
    if weights is not None:
        raise ValueError(f"method '{name}' takes no weights: leave --weights away")
    return PilotedMethod(name, info.make())
