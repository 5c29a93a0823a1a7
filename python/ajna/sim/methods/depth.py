# SPDX-License-Identifier: MIT
"""Methods that measure depth: the truth, a model of the RealSense D435i, and stereo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ajna.sim.methods.base import Mask, largest_region, opened
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["D435iSensor", "DepthPerception", "StereoSensor", "TrueDepthSensor"]

Depth = NDArray[np.float32]
_TASKS = frozenset({"navigate", "gap", "dodge", "pile"})


class TrueDepthSensor:
    """Depth as the renderer knows it."""

    needs = frozenset({"depth"})
    noise = 0.0  # relative depth steps that are not to be trusted
    open_px = 0

    def reset(self, setup: TaskSetup) -> None: ...

    def __call__(self, observation: Observation) -> Depth:
        return observation.frame.depth


class D435iSensor:
    """True depth with the faults of an active stereo camera.

    Range 0.3 to 10 m; noise of the disparity, hence one that grows with the square of the distance (stereo with 50 mm
    baseline and 0.08 px matching error at this image's focal length); holes where depth jumps and, at random, in
    patches; things that move by themselves are seen where they were one frame ago.
    """

    needs = frozenset({"depth"})
    noise = 0.02
    open_px = 3
    RANGE_M = (0.3, 10.0)
    BASELINE_M, MATCH_ERROR_PX = 0.05, 0.08
    JUMP = 0.05  # relative depth step that makes a hole

    def reset(self, setup: TaskSetup) -> None:
        self._random = np.random.default_rng([setup.seed, 0xD435])
        self._before: tuple[Depth, NDArray[np.int32]] | None = None

    def __call__(self, observation: Observation) -> Depth:
        import cv2

        frame = observation.frame
        true, body = frame.depth, frame.body
        depth = true.copy()
        if self._before is not None:  # body 0 is the world, -1 the sky
            moving_now, moving_before = body > 0, self._before[1] > 0
            depth[moving_now] = self._before[0][moving_now]
            depth[moving_before] = self._before[0][moving_before]
        self._before = (true, body)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(np.isfinite(depth), 1 / depth, 0.0).astype(np.float32)
            kernel = np.ones((3, 3), np.uint8)
            edge = cv2.dilate(inverse, kernel) > cv2.erode(inverse, kernel) * (1 + self.JUMP) + 0.01
            # Of the disparity: noise on the depth itself would bring some of the far background within range.
            sigma = self.MATCH_ERROR_PX / (frame.camera.focal_px * self.BASELINE_M)
            measured = inverse + sigma * self._random.standard_normal(depth.shape)
            noisy = np.where(measured > 0, 1 / measured, np.inf)
        low, high = self.RANGE_M
        coarse = self._random.random((depth.shape[0] // 16 + 1, depth.shape[1] // 16 + 1), dtype=np.float32)
        patchy = cv2.resize(coarse, depth.shape[::-1], interpolation=cv2.INTER_CUBIC) > 0.985
        bad = edge | patchy | ~(noisy > low) | ~(noisy < high)
        return np.where(bad, np.nan, noisy).astype(np.float32)


class StereoSensor:
    """Semi-global matching (OpenCV) of two cameras; MorphEyes chooses the baseline for the task."""

    needs = frozenset({"rgb", "right"})
    noise = 0.05
    open_px = 3
    BASELINE_M: ClassVar[dict[str, float]] = {"navigate": 0.20, "gap": 0.15, "dodge": 0.20, "pile": 0.05}
    # Slow flights are flights among near things: the wide baseline sees nothing nearer than 0.75 m.
    SLOW_M_S, SLOW_BASELINE_M = 4.0, 0.10

    def __init__(self) -> None:
        import cv2

        create: Any = cv2.StereoSGBM_create  # type: ignore[attr-defined]  # missing in the stubs
        self._matcher: Any = create(
            minDisparity=0, numDisparities=64, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1,
            uniquenessRatio=8, speckleWindowSize=60, speckleRange=2, preFilterCap=31,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip

    def reset(self, setup: TaskSetup) -> None:
        self.baseline_m = self.BASELINE_M[setup.task]
        if setup.task == "navigate" and setup.speed_m_s < self.SLOW_M_S:
            self.baseline_m = self.SLOW_BASELINE_M

    def __call__(self, observation: Observation) -> Depth:
        import cv2

        frame = observation.frame
        left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.rgb, frame.right(self.baseline_m)))
        # A margin on the left, so that the strip there that only the left camera sees costs no picture.
        margin = 64
        padded = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
        disparity = self._matcher.compute(*padded)[:, margin:].astype(np.float32) / 16
        with np.errstate(divide="ignore"):
            return np.where(disparity > 0.5, frame.camera.focal_px * self.baseline_m / disparity, np.nan)


class DepthPerception:
    """What the paper does with depth: obstacles as they stand; foreground and background of a gap by clustering; thrown
    objects by what is nearer than before; piles by what stands out of the plane that fits best."""

    tasks = _TASKS
    CLOSER = 0.08  # relative change of depth that is an object
    OUT_OF_PLANE_M = 0.008

    def __init__(self, make_sensor: Callable[[], Any]) -> None:
        self._sensor = make_sensor()
        self.needs: frozenset[str] = self._sensor.needs

    def reset(self, setup: TaskSetup) -> None:
        self._sensor.reset(setup)
        self._task = setup.task
        self._background: Depth | None = None

    @property
    def baseline_m(self) -> float:
        """Of a stereo sensor's second camera."""
        return float(self._sensor.baseline_m)

    def depth(self, observation: Observation) -> Depth:
        return self._sensor(observation)

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        depth = self._sensor(observation)
        if self._task == "gap":
            return self._gap(depth)
        if self._task == "dodge":
            return self._thrown(depth)
        return self._pile(depth, observation)

    def _gap(self, depth: Depth) -> Mask | None:
        """The largest region that lies well behind the nearer of two clusters of depth (Otsu)."""
        import cv2

        known = np.isfinite(depth)
        if known.mean() < 0.05:
            return None
        inverse = np.where(known, 1 / np.maximum(depth, 0.1), 0).astype(np.float32)
        levels = np.clip(inverse * 255, 0, 255).astype(np.uint8)
        threshold, _ = cv2.threshold(levels[known].reshape(-1, 1), 0, 255, cv2.THRESH_OTSU)
        front, behind = np.median(depth[known & (levels > threshold)]), depth[known & (levels <= threshold)]
        if behind.size < 20 or np.median(behind) < front * 1.15:
            return None
        mask = opened(known & (levels <= threshold), self._sensor.open_px, 2 * self._sensor.open_px + 1)
        return _inner_region(mask)

    def _thrown(self, depth: Depth) -> Mask | None:
        if self._background is None:
            self._background = np.where(np.isfinite(depth), depth, np.inf).astype(np.float32)
            return None
        near = np.isfinite(depth) & (depth < self._background * (1 - self.CLOSER - 2 * self._sensor.noise) - 0.05)
        near &= np.isfinite(self._background)
        return largest_region(opened(near, self._sensor.open_px, 3), least_px=6)

    def _pile(self, depth: Depth, observation: Observation) -> Mask | None:
        """A plane is linear in inverse depth over the image: fit, drop what stands out, fit again."""
        known = np.isfinite(depth)
        rays = observation.frame.camera.rays
        inverse = np.where(known, 1 / np.maximum(depth, 0.05), 0.0)
        use = known.copy()
        above = np.zeros_like(known)
        for _ in range(8):
            plane, *_ = np.linalg.lstsq(rays[use], inverse[use], rcond=None)
            with np.errstate(divide="ignore", invalid="ignore"):
                height = np.where(known, 1 / (rays @ plane) - depth, 0.0)
            spread = 1.4826 * np.median(np.abs(height[use]))
            # The first fits are tilted by what lies on the table; without noise the spread then vanishes.
            limit = max(self.OUT_OF_PLANE_M, 3 * float(spread))
            above = known & (height > limit)
            use = known & (np.abs(height) < limit)
            if use.sum() < 100:
                return None
        mask = opened(above, self._sensor.open_px, 2 * self._sensor.open_px + 1)
        return mask if mask.any() else None


def _inner_region(mask: Mask) -> Mask | None:
    """The largest region of a mask that does not touch the picture's left and right border, else the largest."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return None
    left, width = stats[1:, cv2.CC_STAT_LEFT], stats[1:, cv2.CC_STAT_WIDTH]
    inner = (left > 0) & (left + width < mask.shape[1])
    areas = stats[1:, cv2.CC_STAT_AREA] * np.where(inner, 1.0, 0.05)
    best = int(areas.argmax())
    return labels == best + 1 if stats[1 + best, cv2.CC_STAT_AREA] >= 20 else None
