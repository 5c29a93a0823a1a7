# SPDX-License-Identifier: MIT
"""One frame pair with its ground truth: the item that every data set of `ajna.data` yields."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Truth:
    """Ground truth of one direction, on the grid of the frame that the motion starts from.

    Attributes:
        flow: float32 [H, W, 2], pixels, 0 where not valid.
        valid: bool [H, W], where the ground truth is known and may be scored or learned.
        occlusion: bool [H, W], visible in this frame and hidden in, or outside, the other; None if the set has none.
        motion_boundary: bool [H, W], where the motion jumps; None if the set has none.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    occlusion: NDArray[np.bool_] | None = None
    motion_boundary: NDArray[np.bool_] | None = None

    def resized(self, width: int, height: int) -> Truth:
        """Everything by the nearest pixel, vectors scaled by width / W and height / H."""
        old_height, old_width = self.valid.shape
        scale = np.array([width / old_width, height / old_height], dtype=np.float32)
        rows, columns = nearest_pixels(old_height, height), nearest_pixels(old_width, width)

        def pick(array: NDArray[Any]) -> NDArray[Any]:
            return array[rows][:, columns]

        return Truth(
            pick(self.flow) * scale,
            pick(self.valid),
            None if self.occlusion is None else pick(self.occlusion),
            None if self.motion_boundary is None else pick(self.motion_boundary),
        )


@dataclass(frozen=True)
class FramePair:
    """One pair. Arrays are on frame 1's grid; what the data set does not have is None.

    Attributes:
        name: the case's name, unique in its data set.
        frame1, frame2: RGB uint8 [H, W, 3].
        flow: ground truth float32 [H, W, 2], pixels, 0 where not valid.
        valid: bool [H, W], where the ground truth is known and may be scored; None exactly where `flow` is.
        occlusion: bool [H, W], visible in frame 1 and hidden in, or outside, frame 2.
        motion_boundary: bool [H, W], where the motion jumps.
        backward: the ground truth from frame 2 to frame 1, on frame 2's grid.
    """

    name: str
    frame1: NDArray[np.uint8]
    frame2: NDArray[np.uint8]
    flow: NDArray[np.float32] | None = None
    valid: NDArray[np.bool_] | None = None
    occlusion: NDArray[np.bool_] | None = None
    motion_boundary: NDArray[np.bool_] | None = None
    backward: Truth | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.frame1.shape[1], self.frame1.shape[0]

    @property
    def truth(self) -> Truth | None:
        """The forward ground truth in one piece; None without flow."""
        if self.flow is None or self.valid is None:
            return None
        return Truth(self.flow, self.valid, self.occlusion, self.motion_boundary)

    def swapped(self) -> FramePair:
        """The pair in the other order of time, the backward ground truth in front.

        Raises:
            ValueError: there is no backward ground truth.
        """
        if self.backward is None:
            raise ValueError(f"case '{self.name}' has no backward ground truth; load the data set with backward=True.")
        back = self.backward
        return FramePair(
            self.name, self.frame2, self.frame1, back.flow, back.valid, back.occlusion, back.motion_boundary, self.truth
        )

    def resized(self, width: int, height: int) -> FramePair:
        """The pair at another size: frames by area, ground truth and masks by the nearest pixel, vectors scaled.

        Nearest, because ground truth may be sparse and flow edges are real: an average over a motion boundary would be
        a motion that no point has. u is scaled by width / W, v by height / H.
        """
        if width < 1 or height < 1:
            raise ValueError(f"size {width}x{height} is not a picture; both sides must be at least 1 pixel.")
        if (width, height) == self.size:
            return self
        truth = None if self.truth is None else self.truth.resized(width, height)
        occlusion = self.occlusion
        if truth is not None:
            occlusion = truth.occlusion
        elif occlusion is not None:  # a mask without flow
            occlusion = occlusion[nearest_pixels(occlusion.shape[0], height)][
                :, nearest_pixels(occlusion.shape[1], width)
            ]
        return replace(
            self,
            frame1=resize_area(self.frame1, width, height),
            frame2=resize_area(self.frame2, width, height),
            flow=None if truth is None else truth.flow,
            valid=None if truth is None else truth.valid,
            occlusion=occlusion,
            motion_boundary=None if truth is None else truth.motion_boundary,
            backward=None if self.backward is None else self.backward.resized(width, height),
        )


def nearest_pixels(old: int, new: int) -> NDArray[np.intp]:
    """For each of `new` samples the old pixel that holds its centre."""
    return np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.intp), old - 1)


def resampling_weights(old: int, new: int) -> NDArray[np.float64]:
    """Weights [new, old], rows summing to 1: area overlap when shrinking, linear interpolation when enlarging."""
    if new <= old:
        edges = np.arange(new + 1) * old / new
        pixel = np.arange(old)
        overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
        return np.clip(overlap, 0.0, None) * new / old
    centre = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
    lower = np.minimum(centre.astype(np.intp), max(old - 2, 0))
    weights = np.zeros((new, old))
    np.add.at(weights, (np.arange(new), lower), 1.0 - (centre - lower))
    np.add.at(weights, (np.arange(new), np.minimum(lower + 1, old - 1)), centre - lower)
    return weights


def resize_area(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Resize an image uint8 [H, W, C]: each new pixel is the mean over its area (linear interpolation to enlarge)."""
    rows = resampling_weights(image.shape[0], height) @ image.reshape(image.shape[0], -1).astype(np.float64)
    rows = rows.reshape(height, image.shape[1], image.shape[2])
    resized = np.matmul(resampling_weights(image.shape[1], width), rows)
    return np.clip(np.rint(resized), 0, 255).astype(np.uint8)
