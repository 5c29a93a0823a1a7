# SPDX-License-Identifier: MIT
"""A method on pairs from which the motion of the largest plane is taken out first, as the skills look at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ajna import tasks
from ajna.baselines.classical import FlowMethod, Map, RgbImage

__all__ = ["Aligned", "AlignedField", "with_aligned"]


@dataclass(frozen=True)
class AlignedField:
    """As ajna.FlowField, float32 [H, W, 2] each: flow between the frames as they were, pixels; uncertainty and expected
    error as the method gave them for the aligned pair, the latter in pixels of the aligned frame (those of frame 2, but
    for the homography's scale)."""

    flow: Map
    uncertainty: Map
    expected_error: Map
    label = "uncertainty after alignment"  # for pictures


class Aligned:
    """``method`` after :func:`ajna.tasks.align_to`: frame 2 is warped by the homography that most tracked corners agree
    on, the method sees what else moves, and its flow p -> q is carried back by the homography H: p -> H(q).

    Frames are RGB uint8 [H, W, 3] of one size; raises what ``method`` and ``align_to`` raise. Where the warped frame
    has no picture the method sees its border repeated. Pairs without a plane are left as they are.
    """

    def __init__(self, method: FlowMethod) -> None:
        self.method = method

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> Any:
        alignment = tasks.align_to(frame1, frame2)
        if not alignment.found:
            return self.method(frame1, frame2)
        field = self.method(frame1, alignment.image)
        frame_from_reference = np.linalg.inv(alignment.reference_from_frame)
        return AlignedField(
            carried(np.asarray(field.flow), frame_from_reference),
            np.asarray(field.uncertainty),
            np.asarray(field.expected_error),
        )


def with_aligned(methods: Mapping[str, FlowMethod]) -> dict[str, FlowMethod]:
    """The methods, then each of them once more after alignment, as "NAME-aligned"."""
    return {**methods, **{f"{name}-aligned": Aligned(method) for name, method in methods.items()}}


def carried(flow: Map, homography: np.ndarray) -> Map:
    """The flow whose end points [H, W, 2] are those of ``flow``, moved by a 3x3 homography of pixel coordinates."""
    height, width = flow.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    ends = np.stack([x + flow[..., 0], y + flow[..., 1], np.ones_like(x)], axis=-1) @ homography.T
    return np.stack([ends[..., 0] / ends[..., 2] - x, ends[..., 1] / ends[..., 2] - y], axis=-1).astype(np.float32)
