# SPDX-License-Identifier: MIT
"""The methods by name: Ajna, the same on the true flow, and the reference methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ajna import _core
from ajna.sim.methods.adapter import InstanceMasks, MonocularDepth, Network, PairNetwork
from ajna.sim.methods.base import PilotedMethod
from ajna.sim.methods.blind import Blind
from ajna.sim.methods.depth import D435iSensor, DepthPerception, StereoSensor, TrueDepthSensor
from ajna.sim.methods.events import EventPerception
from ajna.sim.methods.flow import GapFlyt, OcclusionMask
from ajna.sim.methods.program import FlightProgram
from ajna.sim.methods.signals import NetworkSignal, TrueFlowSignal, TrueMotionSignal
from ajna.sim.methods.skills import OUR_VEHICLE, OUR_VEHICLE_BFLOAT16, PAPERS_VEHICLE, Pace, SkillMethod, Timing

__all__ = ["METHODS", "MethodInfo", "make_method"]


@dataclass(frozen=True)
class MethodInfo:
    """A method's name in the paper, what it does, and how to make what it sees with.

    ``network``: the kind of network of the user's that ``make`` takes; None: no network. ``timing``: of a method that
    flies by Ajna's pipelines and policies; ``make`` then gives its signal instead of a perception.
    ``takes_checkpoint``: ``make`` takes a model file of Ajna's, or None for the shipped one. ``whole``: ``make`` gives
    the method itself.
    """

    title: str
    tasks: frozenset[str]
    make: Callable[..., Any]
    network: type[Network] | type[PairNetwork] | None = None
    timing: Pace | None = None
    takes_checkpoint: bool = False
    whole: bool = False

    @property
    def needs_weights(self) -> bool:
        """Whether nothing flies without a network of the user's."""
        return self.network is not None


_ALL = frozenset({"navigate", "gap", "dodge", "pile"})
METHODS: dict[str, MethodInfo] = {
    "ajna": MethodInfo("Ajna", _ALL, NetworkSignal, timing=Timing(), takes_checkpoint=True),
    "ajna-8hz": MethodInfo(
        "Ajna, at the paper's 8 Hz", _ALL, NetworkSignal, timing=PAPERS_VEHICLE, takes_checkpoint=True
    ),
    "ajna-flight-pace": MethodInfo(
        "Ajna, at the flight program's pace", _ALL, NetworkSignal, timing=OUR_VEHICLE, takes_checkpoint=True
    ),
    "ajna-flight-pace-bfloat16": MethodInfo(
        "Ajna in bfloat16, at the flight program's pace",
        _ALL,
        lambda weights: NetworkSignal(weights, bfloat16=True),
        timing=OUR_VEHICLE_BFLOAT16,
        takes_checkpoint=True,
    ),
    "ajna-true-flow": MethodInfo("Ajna on true flow", _ALL, TrueFlowSignal, timing=Timing()),
    "ajna-true-flow-8hz": MethodInfo("Ajna on true flow, at 8 Hz", _ALL, TrueFlowSignal, timing=PAPERS_VEHICLE),
    "ajna-true-flow-flight-pace": MethodInfo(
        "Ajna on true flow, at the flight program's pace", _ALL, TrueFlowSignal, timing=OUR_VEHICLE
    ),
    "ajna-true-motion": MethodInfo("Ajna on true motion", frozenset({"navigate"}), TrueMotionSignal, timing=Timing()),
    "ajna-true-motion-8hz": MethodInfo(
        "Ajna on true motion, at 8 Hz", frozenset({"navigate"}), TrueMotionSignal, timing=PAPERS_VEHICLE
    ),
    "ajna-true-motion-flight-pace": MethodInfo(
        "Ajna on true motion, at the flight program's pace",
        frozenset({"navigate"}),
        TrueMotionSignal,
        timing=OUR_VEHICLE,
    ),
    "flight": MethodInfo("Ajna, flight program", FlightProgram.tasks, FlightProgram, takes_checkpoint=True, whole=True),
    "depth": MethodInfo("true depth", _ALL, lambda: DepthPerception(TrueDepthSensor)),
    "d435i": MethodInfo("D435i (model)", _ALL, lambda: DepthPerception(D435iSensor)),
    "morpheyes": MethodInfo("MorphEyes (SGBM)", _ALL, lambda: DepthPerception(StereoSensor)),
    "occmask": MethodInfo("OccMask (DIS, forward-backward)", OcclusionMask.tasks, OcclusionMask),
    "occmask-net": MethodInfo("OccMask (network)", OcclusionMask.tasks, OcclusionMask, PairNetwork),
    "gapflyt": MethodInfo("GapFlyt (DIS)", GapFlyt.tasks, GapFlyt),
    "gapflyt-pwcnet": MethodInfo("GapFlyt (PWC-Net)", GapFlyt.tasks, GapFlyt, PairNetwork),
    "gapflyt-flownet2": MethodInfo("GapFlyt (FlowNet2)", GapFlyt.tasks, GapFlyt, PairNetwork),
    "gapflyt-spynet": MethodInfo("GapFlyt (SpyNet)", GapFlyt.tasks, GapFlyt, PairNetwork),
    "events": MethodInfo("event density", EventPerception.tasks, EventPerception),
    "evdodgenet": MethodInfo("EVDodgeNet (SegNet)", EventPerception.tasks, EventPerception, Network),
    "evdodgenet-flow": MethodInfo(
        "EVDodgeNet (DB + H + SegFlowNet)", EventPerception.tasks, lambda net: EventPerception(net, frames=2), Network
    ),
    "midas": MethodInfo("MiDaS", _ALL, MonocularDepth, Network),
    "midas-s": MethodInfo("MiDaS-S", _ALL, MonocularDepth, Network),
    "mask-rcnn": MethodInfo("Mask R-CNN", InstanceMasks.tasks, InstanceMasks, Network),
    "pointrend": MethodInfo("PointRend", InstanceMasks.tasks, InstanceMasks, Network),
    "blind": MethodInfo("none (flies straight, hovers)", _ALL, Blind),
}


def make_method(name: str, weights: str | Path | None = None, size: tuple[int, int] | None = None) -> Any:
    """A method by name.

    ``weights``, ``size``: file and (height, width) of the network of a method that takes one; for ``ajna`` a model
    file, None being the shipped one.

    Raises:
        ValueError: an unknown name (the nearest is named), weights missing, or given where none are used.
        FileNotFoundError: no such file.
    """
    if name not in METHODS:
        near = _core.nearest_name(name, list(METHODS))
        hint = f"did you mean '{near}'? " if near else ""
        raise ValueError(f"unknown method '{name}'; {hint}Known: {', '.join(METHODS)}")
    info = METHODS[name]
    if info.network is not None:
        if weights is None:
            raise ValueError(f"method '{name}' needs a network: give its TorchScript or ONNX file by --weights FILE")
        return PilotedMethod(name, info.make(info.network(weights, size)))
    if info.whole:
        return info.make(weights)
    if info.takes_checkpoint:
        return SkillMethod(name, info.make(weights), info.timing)
    if weights is not None:
        raise ValueError(f"method '{name}' takes no weights: leave --weights away")
    if info.timing is not None:
        return SkillMethod(name, info.make(), info.timing)
    return PilotedMethod(name, info.make())
