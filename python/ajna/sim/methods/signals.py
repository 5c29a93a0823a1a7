# SPDX-License-Identifier: MIT
"""Maps of uncertainty for the skills: from a network, and from the true flow as the best that such a map can be."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import ajna
from ajna import tasks
from ajna.sim.camera import Frame
from ajna.sim.observation import Observation
from ajna.sim.truth import occlusion_and_flow

__all__ = ["NetworkSignal", "Signal", "TrueFlowSignal", "occlusion_jump"]

Map = NDArray[np.float32]


class Signal(Protocol):
    """Uncertainty of the flow from ``first`` to ``second`` in pixels, on the first one's grid.

    float32 [H, W], or [H, W, 2] per axis.

    ``needs``: the pictures it uses ("rgb", "depth"). ``common``: which motion is to be taken out of the pair first, see
    :class:`NetworkSignal`; where flow is known that makes no difference.
    """

    needs: frozenset[str]

    def __call__(self, first: Observation, second: Observation, common: str = "none") -> Map: ...


@lru_cache(maxsize=2)
def _model(name_or_path: str) -> Any:
    """One network per process, whatever the number of trials."""
    return ajna.load(name_or_path)


class NetworkSignal:
    """What a network says of its own flow, after what it need not see is taken out of the pair.

    ``common``: "rotation" takes out the camera's turning, which the IMU knows; "plane" the motion of most of the
    picture (the wall around a gap); "none" nothing. What then has no picture gets the median uncertainty.

    Args:
        weights: a checkpoint or TorchScript file of Ajna's; None: the shipped model.

    Raises:
        FileNotFoundError: no such file; ValueError: a foreign or damaged one.
    """

    needs = frozenset({"rgb"})

    def __init__(self, weights: str | Path | None = None) -> None:
        self._model = _model("best" if weights is None else str(weights))

    def __call__(self, first: Observation, second: Observation, common: str = "none") -> Map:
        if common == "none":
            return self._model(first.rgb, second.rgb, second.frame.time_s).uncertainty
        if common == "plane":
            aligned = tasks.align_to(first.rgb, second.rgb)
        else:
            turn = _north_from_camera(first).T @ _north_from_camera(second)
            aligned = tasks.derotate_frame(second.rgb, turn, first.frame.camera.horizontal_fov_rad)
        return aligned.within(self._model(first.rgb, aligned.image, second.frame.time_s).uncertainty)


def _north_from_camera(observation: Observation) -> NDArray[np.float64]:
    """The camera's attitude as the IMU has it, against axes that do not turn with the vehicle."""
    c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ observation.heading_from_camera


class TrueFlowSignal:
    """Forward-backward occlusion from the true flow: what a network could know at best of covering and uncovering."""

    needs = frozenset({"depth"})

    def __call__(self, first: Observation, second: Observation, common: str = "none") -> Map:
        return occlusion_jump(first.frame, second.frame)


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
