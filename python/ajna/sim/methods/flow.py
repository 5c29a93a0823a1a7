# SPDX-License-Identifier: MIT
"""Methods on optical flow: occlusion masks (OccMask) and stacked flow magnitude (GapFlyt)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna.baselines import FlowMethod, make_baseline
from ajna.sim.methods.adapter import PairNetwork
from ajna.sim.methods.base import NOMINAL_DISTANCE_M, Map, Mask, largest_region, opened
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["GapFlyt", "OcclusionMask", "RegionTracker", "derotated"]


def derotated(flow: NDArray[np.floating], first: Observation, second: Observation) -> NDArray[np.float32]:
    """Flow without the part that the camera's rotation causes, known from the IMU; float32 [H, W, 2]."""
    camera = first.frame.camera

    def to_north(observation: Observation) -> NDArray[np.float64]:
        # heading frame (forward, right, down), turned back by the yaw (about up)
        c, s = np.cos(observation.yaw_rad), np.sin(observation.yaw_rad)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ observation.heading_from_camera

    turn = to_north(second).T @ to_north(first)
    pixels, _ = camera.project(camera.rays @ turn.T)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return (flow - (pixels - np.stack([columns, rows], -1))).astype(np.float32)


class OcclusionMask:
    """Pixels whose forward and backward flow disagree: hidden or uncovered between two frames.

    Pixels that come from outside of the other frame disagree as well, without being occluded: they do not count.

    Args:
        flow: name of a baseline, any flow method whose ``uncertainty`` is that disagreement, or a network of the user's
            that gives flow or the mask itself.
    """

    tasks = frozenset({"navigate", "gap", "dodge", "pile"})
    needs = frozenset({"rgb"})
    RELATIVE, ABSOLUTE_PX = 0.05, 0.7  # disagreement that counts: a share of the flow, plus pixels
    BORDER_PX = 4

    def __init__(self, flow: str | FlowMethod | PairNetwork = "dis") -> None:
        self._flow = make_baseline(flow) if isinstance(flow, str) else flow

    def reset(self, setup: TaskSetup) -> None:
        self._task = setup.task
        self._previous: NDArray[np.uint8] | None = None
        self._tracker = RegionTracker()
        self._sum: NDArray[np.float32] | None = None

    def _occluded(self, observation: Observation) -> Mask | None:
        previous, self._previous = self._previous, observation.rgb
        if previous is None:
            return None
        # From the new frame to the old one, so that the mask lies on the new frame.
        if isinstance(self._flow, PairNetwork):
            answer = self._flow.answer(self._previous, previous)
            if len(answer) == 1:
                return np.asarray(answer[0] > 0.5)
            field = self._flow.with_distance(answer, self._previous, previous)
        else:
            field = self._flow(self._previous, previous)
        size = np.linalg.norm(field.flow, axis=2)
        disagrees = np.linalg.norm(field.uncertainty, axis=2) > self.ABSOLUTE_PX + self.RELATIVE * size
        height, width = size.shape
        x = np.arange(width) + field.flow[..., 0]
        y = np.arange(height)[:, None] + field.flow[..., 1]
        # Near the border, too, half a patch of the flow has no counterpart.
        edge = self.BORDER_PX
        inside = (x >= edge) & (y >= edge) & (x <= width - 1 - edge) & (y <= height - 1 - edge)
        inside[:edge], inside[-edge:], inside[:, :edge], inside[:, -edge:] = False, False, False, False
        return disagrees & inside

    def depth(self, observation: Observation) -> Map:
        occluded = self._occluded(observation)
        shape = (observation.frame.camera.height, observation.frame.camera.width)
        if occluded is None:
            return np.full(shape, np.inf, np.float32)
        return np.where(opened(occluded, 3, 5), NOMINAL_DISTANCE_M, np.inf).astype(np.float32)

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        occluded = self._occluded(observation)
        if self._task == "gap":
            if exploring and occluded is not None:
                self._sum = occluded.astype(np.float32) if self._sum is None else self._sum + occluded
            if self._sum is not None and not exploring and not self._tracker.started:
                found = _filled(opened(self._sum >= max(1.0, float(np.quantile(self._sum, 0.9))), 0, 9))
                if found is not None:
                    self._tracker.start(observation.rgb, found)
            return self._tracker(observation.rgb)
        if occluded is None:
            return None
        if self._task == "dodge":
            return largest_region(opened(occluded, 3, 7), least_px=25)
        filled = _filled(opened(occluded, 0, 9))
        return filled


class GapFlyt:
    """The flow's magnitude, stacked over the exploratory frames and inverted, splits near from far; then the contour.

    Args:
        flow: name of a baseline, or any flow method (for example a loaded model).
    """

    tasks = frozenset({"gap"})
    needs = frozenset({"rgb"})

    def __init__(self, flow: str | FlowMethod = "dis") -> None:
        self._flow = make_baseline(flow) if isinstance(flow, str) else flow

    def reset(self, setup: TaskSetup) -> None:
        self._first: Observation | None = None
        self._stack: list[NDArray[np.float32]] = []
        self._tracker = RegionTracker()

    def depth(self, observation: Observation) -> Map:
        raise ValueError("GapFlyt finds gaps only")

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        if exploring:
            if self._first is None:
                self._first = observation
                return None
            flow = self._flow(self._first.rgb, observation.rgb).flow
            self._stack.append(np.linalg.norm(derotated(flow, self._first, observation), axis=2))
            return None
        if self._first is not None and not self._tracker.started:
            found = self._contour(self._stack) if self._stack else None
            if found is not None:
                # The mask lies on the first frame; the tracker carries it from there.
                self._tracker.start(self._first.rgb, found)
        return self._tracker(observation.rgb)

    @staticmethod
    def _contour(stack: list[NDArray[np.float32]]) -> Mask | None:
        """The region of the largest inverse flow inside the picture."""
        import cv2

        mean = np.mean(stack, axis=0)
        inverse = 1 / np.maximum(mean, 0.05 * float(np.median(mean)) + 1e-6)
        top = float(np.quantile(inverse, 0.995))
        levels = cv2.medianBlur(np.clip(255 * inverse / max(top, 1e-6), 0, 255).astype(np.uint8), 5)
        _, binary = cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        mask = opened(binary.astype(bool), 5, 9)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        best, best_contrast = None, 0.0
        for i in range(1, count):
            x, y, w, h, area = stats[i]
            if area < 150 or x == 0 or y == 0 or x + w == mask.shape[1] or y + h == mask.shape[0]:
                continue
            region = labels == i
            ring = cv2.dilate(region.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool) & ~region
            contrast = float(np.median(mean[ring]) - np.median(mean[region]))
            if contrast > best_contrast:
                best, best_contrast = region, contrast
        return best


class RegionTracker:
    """Carries a region from frame to frame by corners around it (pyramidal Lucas-Kanade, checked both ways).

    Between two frames the contour zooms about the focus of expansion: one scale and a shift, as in GapFlyt, found
    robustly from the corners.
    """

    RING_PX = 22

    def __init__(self) -> None:
        self._image: NDArray[np.uint8] | None = None
        self._contour: NDArray[np.float32] | None = None

    @property
    def started(self) -> bool:
        return self._contour is not None

    def start(self, rgb: NDArray[np.uint8], region: Mask) -> None:
        import cv2

        contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        self._contour = max(contours, key=cv2.contourArea).reshape(-1, 2).astype(np.float32)
        self._image = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)

    def __call__(self, rgb: NDArray[np.uint8]) -> Mask | None:
        """The region in this frame, or None before the start."""
        import cv2

        if self._contour is None or self._image is None:
            return None
        grey: Any = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        inside = np.zeros(grey.shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(self._contour).astype(np.int32)], 1)
        outer: Any = cv2.dilate(inside, np.ones((2 * self.RING_PX + 1,) * 2, np.uint8))
        inner: Any = cv2.dilate(inside, np.ones((5, 5), np.uint8))
        ring = outer & (1 - inner)
        corners = cv2.goodFeaturesToTrack(self._image, 120, 0.01, 5, mask=ring)
        if corners is not None and len(corners) >= 8:
            window: dict[str, Any] = {"winSize": (17, 17), "maxLevel": 3}
            track: Any = cv2.calcOpticalFlowPyrLK
            ahead, ok, _ = track(self._image, grey, corners, None, **window)
            back, ok_back, _ = track(grey, self._image, ahead, None, **window)
            good = (ok & ok_back).ravel().astype(bool) & (np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < 1)
            if good.sum() >= 6:
                before, after = corners.reshape(-1, 2)[good], ahead.reshape(-1, 2)[good]
                zoom, _ = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=1.0)
                if zoom is not None:
                    # Without the rotation part, which the body's roll of a few degrees does not warrant.
                    scale = float(np.hypot(zoom[0, 0], zoom[1, 0]))
                    shift = np.median(after - scale * before, axis=0)
                    self._contour = (scale * self._contour + shift).astype(np.float32)
        self._image = grey
        mask = np.zeros(grey.shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(self._contour).astype(np.int32)], 1)
        return mask.astype(bool)


def _filled(edges: Mask) -> Mask | None:
    """The inside of the largest outline that edges close, with the edges; None without edges."""
    import cv2

    contours, _ = cv2.findContours(edges.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    contours = [c for c in contours if cv2.contourArea(c) > 60]
    if not contours:
        return None
    mask = np.zeros(edges.shape, np.uint8)
    cv2.drawContours(mask, [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return mask.astype(bool)
