# SPDX-License-Identifier: MIT
"""OpenCV's DIS and Farneback flow, and zero flow. OpenCV's Python package is imported only when one is made."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

RgbImage = NDArray[np.uint8]
Map = NDArray[np.float32]


class Cost(NamedTuple):
    """What one answer (flow and uncertainty of one pair) takes."""

    passes: int  # of the network, or runs of the classical method
    parameters: int  # learned scalars that must be held; 0 for a classical method
    flops: int | None  # 2 per multiply-accumulate of the network; None where nobody counts them


@dataclass(frozen=True)
class BaselineField:
    """As ajna.FlowField: float32 [H, W, 2] each, pixels. Here uncertainty and expected error are the same."""

    flow: Map
    uncertainty: Map
    label = "forward-backward distance"  # what the uncertainty is, for pictures

    @property
    def expected_error(self) -> Map:
        return self.uncertainty


class FlowMethod(Protocol):
    """Anything that turns two frames RGB uint8 [H, W, 3] into a field: a baseline or an ajna.Model."""

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> Any: ...


class CostedMethod(FlowMethod, Protocol):
    """A method that says what an answer takes at a size."""

    def cost(self, width: int, height: int) -> Cost: ...


def forward_backward_difference(forward: Map, backward: Map) -> Map:
    """Where a pixel ends, relative to its start, after `forward` and then `backward`; float32 [H, W, 2], pixels.

    `backward` [H, W, 2], the flow from frame 2 to frame 1, is read at the end of the forward vector, linearly
    interpolated, outside the frame at its border.
    """
    height, width = forward.shape[:2]
    x = np.clip(np.arange(width, dtype=np.float32) + forward[..., 0], 0, width - 1)
    y = np.clip(np.arange(height, dtype=np.float32)[:, None] + forward[..., 1], 0, height - 1)
    left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = (x - left)[..., None], (y - top)[..., None]
    upper = (1 - a) * backward[top, left] + a * backward[top, right]
    lower = (1 - a) * backward[bottom, left] + a * backward[bottom, right]
    return np.asarray(forward + (1 - b) * upper + b * lower, dtype=np.float32)


class ZeroFlow:
    """Nothing moves: the score of an empty answer. Its uncertainty is the same everywhere: it tells nothing."""

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> BaselineField:
        zero = np.zeros((*frame1.shape[:2], 2), dtype=np.float32)
        return BaselineField(zero, zero)

    def cost(self, width: int, height: int) -> Cost:
        """Nothing."""
        return Cost(0, 0, 0)


class _OpenCvFlow:
    """A flow of two grey images, run both ways."""

    def __init__(self) -> None:
        try:
            self._cv2: Any = importlib.import_module("cv2")
        except ImportError as error:
            raise RuntimeError(
                f"the baseline '{type(self).__name__}' needs OpenCV's Python package, which cannot be imported "
                f"({error}); install it with: pip install opencv-python-headless"
            ) from error

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> BaselineField:
        grey1, grey2 = (self._cv2.cvtColor(frame, self._cv2.COLOR_RGB2GRAY) for frame in (frame1, frame2))
        try:
            forward, backward = self._flow(grey1, grey2), self._flow(grey2, grey1)
        except self._cv2.error as error:
            height, width = grey1.shape
            raise RuntimeError(
                f"{type(self).__name__} cannot handle frames of {width}x{height} (OpenCV: {error.err}); "
                "use larger ones."
            ) from error
        difference = forward_backward_difference(forward, backward)
        return BaselineField(forward, np.abs(difference))

    def cost(self, width: int, height: int) -> Cost:
        """Two runs; OpenCV's operations are not counted."""
        return Cost(2, 0, None)

    def _flow(self, grey1: NDArray[np.uint8], grey2: NDArray[np.uint8]) -> Map:
        raise NotImplementedError


class DenseInverseSearch(_OpenCvFlow):
    """Dense inverse search (Kroeger et al.), OpenCV's medium preset."""

    def __init__(self) -> None:
        super().__init__()
        self._dis = self._cv2.DISOpticalFlow_create(self._cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def _flow(self, grey1: NDArray[np.uint8], grey2: NDArray[np.uint8]) -> Map:
        return np.asarray(self._dis.calc(grey1, grey2, None), dtype=np.float32)


class Farneback(_OpenCvFlow):
    """Farneback's polynomial expansion: 5 levels, window 21, 3 iterations, 7-pixel neighbourhood, sigma 1.5."""

    def _flow(self, grey1: NDArray[np.uint8], grey2: NDArray[np.uint8]) -> Map:
        flow = self._cv2.calcOpticalFlowFarneback(
            grey1, grey2, None, pyr_scale=0.5, levels=5, winsize=21, iterations=3, poly_n=7, poly_sigma=1.5, flags=0
        )
        return np.asarray(flow, dtype=np.float32)


BASELINES: dict[str, Callable[[], CostedMethod]] = {
    "dis": DenseInverseSearch,
    "farneback": Farneback,
    "zero": ZeroFlow,
}


def make_baseline(name: str, also: Iterable[str] = ()) -> CostedMethod:
    """A baseline by name; `also` are names of other kinds that a message for an unknown one may suggest.

    Raises:
        ValueError: an unknown name.
        RuntimeError: it needs OpenCV's Python package, which is not there.
    """
    if name not in BASELINES:
        known = [*BASELINES, *also]
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}."
        raise ValueError(f"unknown baseline method '{name}'; {hint}")
    return BASELINES[name]()
