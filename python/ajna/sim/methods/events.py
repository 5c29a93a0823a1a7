# SPDX-License-Identifier: MIT
"""An event camera, simulated from the rendered intensity, and thrown objects in its event frames."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from ajna.sim.methods.adapter import Network
from ajna.sim.methods.base import Map, Mask, largest_region, opened
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["EventPerception", "EventSensor"]


class EventSensor:
    """Events between two frames: each pixel counts the steps of its log intensity since its last event.

    ``threshold``: the step of the natural logarithm that makes an event.
    """

    def __init__(self, threshold: float = 0.18) -> None:
        self.threshold = threshold
        self._reference: NDArray[np.float32] | None = None

    def __call__(self, rgb: NDArray[np.uint8]) -> NDArray[np.int16]:
        """Signed number of events at each pixel since the last call, int16 [H, W]; zero on the first one."""
        grey = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
        log = np.log(grey + 10.0)  # the 10 stands for the dark current: no storms of events in the shadows
        if self._reference is None:
            self._reference = log
        steps = np.trunc((log - self._reference) / self.threshold).astype(np.int16)
        self._reference = self._reference + steps * np.float32(self.threshold)
        return steps


class EventPerception:
    """Thrown objects in event frames: by a network of the user's, or by the density of the events.

    Args:
        network: takes the last ``frames`` event frames, float32 [1, 3 * frames, H, W] (of each: positive, negative,
            both; counts scaled to at most 1; the newest last) and gives the probability of an obstacle [1, 1, H, W];
            None: density of events above that of the background.
        frames: how many event frames the network sees.
    """

    tasks = frozenset({"dodge"})
    needs = frozenset({"rgb"})

    def __init__(self, network: Network | None = None, frames: int = 1) -> None:
        self._network = network
        self._recent: deque[NDArray[np.float32]] = deque(maxlen=frames)

    def reset(self, setup: TaskSetup) -> None:
        self._sensor = EventSensor()
        self._frames = 0
        self._recent.clear()

    def depth(self, observation: Observation) -> Map:
        raise ValueError("event frames find thrown objects only")

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        import cv2

        events = self._sensor(observation.rgb)
        self._frames += 1
        if self._network is not None:
            up, down = np.maximum(events, 0), np.maximum(-events, 0)
            stacked = np.stack([up, down, np.abs(events)]).astype(np.float32)
            self._recent.append(stacked / max(float(stacked.max()), 1.0))
        if self._frames < 3:
            return None
        if self._network is not None:
            return largest_region(self._network(np.concatenate(self._recent)) > 0.5, least_px=12)
        active = (events != 0).astype(np.float32)
        density = cv2.boxFilter(active, -1, (5, 5))
        limit = max(0.35, float(np.quantile(cv2.boxFilter(active, -1, (31, 31)), 0.5)) * 2.5)
        return largest_region(opened(density > limit, 3, 7), least_px=20)
