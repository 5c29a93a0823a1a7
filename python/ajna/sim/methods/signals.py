# SPDX-License-Identifier: MIT
"""Maps of uncertainty for the skills: from a network, and from the true flow as the best that such a map can be."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import ajna
from ajna import tasks
from ajna.sim.camera import CameraModel, Frame
from ajna.sim.observation import Observation
from ajna.sim.truth import occlusion_and_flow

__all__ = ["NetworkSignal", "Signal", "Source", "TrueFlowSignal", "TrueMotionSignal", "occlusion_jump"]

Map = NDArray[np.float32]


#: (first, second, common motion to be taken out) -> map, float32 [H, W] or [H, W, 2] on the first frame's grid.
Source = Callable[[tasks.Snapshot, tasks.Snapshot, str], NDArray[np.float32]]


class Signal(Protocol):
    """Uncertainty of the flow between two frames, in a form that :class:`ajna.tasks.Skill` takes.

    ``needs``: the pictures it uses ("rgb", "depth").
    """

    needs: frozenset[str]

    def source(self, camera: CameraModel) -> Source: ...

    def adapt(self, options: tasks.SkillOptions) -> None:
        """Change what depends on the signal's units; the defaults are the shipped network's."""


@lru_cache(maxsize=2)
def _model(name_or_path: str, bfloat16: bool) -> Any:
    """One network per process, whatever the number of trials."""
    return ajna.load(name_or_path, bfloat16=bfloat16)


class NetworkSignal:
    """What a network says of its own flow; see :class:`ajna.tasks.NetworkSignal`.

    Args:
        weights: a checkpoint or TorchScript file of Ajna's; None: the shipped model.
        bfloat16: run it in bfloat16, as ``model.bfloat16`` of a flight does: checkpoints only.

    Raises:
        FileNotFoundError: no such file; ValueError: a foreign or damaged one, or TorchScript with ``bfloat16``.
    """

    needs = frozenset({"rgb"})

    def __init__(self, weights: str | Path | None = None, bfloat16: bool = False) -> None:
        self._model = _model("best" if weights is None else str(weights), bfloat16)

    def source(self, camera: CameraModel) -> Source:
        """The network's signal for a camera."""
        return tasks.NetworkSignal(self._model.engine, camera.horizontal_fov_rad)

    def adapt(self, options: tasks.SkillOptions) -> None:
        """Nothing: the defaults are for networks."""


class TrueFlowSignal:
    """Forward-backward occlusion from the true flow: what a network could know at best of covering and uncovering.

    Which motion two frames have in common makes no difference to it.
    """

    needs = frozenset({"depth"})

    def source(self, camera: CameraModel) -> Source:
        """Reads the frames from the observations that the snapshots are tagged with."""
        return lambda first, second, common: occlusion_jump(first.tag.frame, second.tag.frame)

    def adapt(self, options: tasks.SkillOptions) -> None:
        """Pixels of flow, in narrow rims: as strong as the motion itself, which the mean over a band weakens little."""
        options.horizon.floor, options.horizon.per_px, options.horizon.least_shift_px = 0.02, 1.0, 3.0
        options.horizon.saturated = 1e6


class TrueMotionSignal:
    """The map that navigating takes a network's for, from true depth: uncertainty that grows with a point's motion.

    That is the law of :class:`ajna.tasks.HorizonOptions`, without a network's errors and blur: what is lost on it is
    lost by planning and control, and what a network loses beyond that by its signal.
    """

    needs = frozenset({"depth"})

    def __init__(self) -> None:
        self._law = tasks.HorizonOptions()

    def source(self, camera: CameraModel) -> Source:
        """Reads depth, attitude and velocity from the observations that the snapshots are tagged with."""
        return lambda first, second, common: self._map(first.tag, second.tag)

    def adapt(self, options: tasks.SkillOptions) -> None:
        """The map is made by the law that the skill will read it by, and has no bound."""
        options.horizon.saturated = 1e6
        self._law = options.horizon

    def _map(self, seen: Observation, before: Observation) -> Map:
        camera, law = seen.frame.camera, self._law
        pose = seen.frame.T_world_camera
        move = pose[:3, :3].T @ (pose[:3, 3] - before.frame.T_world_camera[:3, 3])
        focus, ahead = camera.project(move)
        if not ahead > 0:  # backwards or at rest: the skill looks at no map then
            return np.full(seen.frame.depth.shape, law.floor, np.float32)
        pixels, _ = camera.project(camera.rays)
        shift = np.linalg.norm(pixels - focus, axis=2) + law.least_shift_px
        inverse = np.where(np.isfinite(seen.frame.depth), 1 / np.maximum(seen.frame.depth, 1e-3), 0.0)
        return (law.floor + law.per_px * np.linalg.norm(move) * shift * inverse).astype(np.float32)


def occlusion_jump(first: Frame, second: Frame) -> Map:
    """Where something is covered or uncovered between two frames, and by how much flow jumps there.

    A pixel that is hidden in the second frame arrives on what hides it; the flow back from there does not lead home,
    and the distance by which it misses is the difference of the two surfaces' motion. What is uncovered in the second
    frame has no pixel in the first one; it is marked where it would be, on what hides it. So an outline is marked on
    both of its sides. Pixels that leave the picture are not hidden.

    Returns:
        float32 [H, W], pixels, on the first frame's grid; 0 where nothing is hidden.
    """
    occluded, forward = occlusion_and_flow(first, second)
    uncovered, backward = occlusion_and_flow(second, first)
    covered_jump, _, _ = _jump(occluded, forward, backward)
    uncovered_jump, column, row = _jump(uncovered, backward, forward)
    result = covered_jump
    hidden = uncovered_jump > 0
    np.maximum.at(result, (row[hidden], column[hidden]), uncovered_jump[hidden])
    return result


def _jump(hidden: NDArray[np.bool_], there: Map, back: Map) -> tuple[Map, NDArray[np.intp], NDArray[np.intp]]:
    """By how much ``back`` misses the pixel that ``there`` started from, and (column, row) of the pixel arrived at."""
    height, width = hidden.shape
    rows, columns = np.mgrid[:height, :width]
    x, y = columns + there[..., 0], rows + there[..., 1]
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)  # False for NaN
    column = np.rint(np.where(inside, x, 0)).astype(np.intp)
    row = np.rint(np.where(inside, y, 0)).astype(np.intp)
    miss = np.linalg.norm(there + back[row, column], axis=2)
    miss = np.minimum(miss, np.hypot(height, width))  # close to the camera's plane flow has no bound
    return np.where(hidden & inside & np.isfinite(miss), miss, 0).astype(np.float32), column, row
