# SPDX-License-Identifier: MIT
"""A reference method: something that perceives, and the shared pilots that act on it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.pilots import DodgePilot, GapPilot, NavigatePilot

__all__ = ["NOMINAL_DISTANCE_M", "Perception", "PilotedMethod", "largest_region", "opened"]

Mask = NDArray[np.bool_]
Map = NDArray[np.floating]

NOMINAL_DISTANCE_M = 3.0  # where the obstacles of a mask without distances are taken to be


class Perception(Protocol):
    """How a method sees. One object serves one trial after another; ``reset`` starts a new one.

    ``tasks``: what it can do. ``needs``: the pictures it uses ("rgb", "right", "depth").
    """

    tasks: frozenset[str]
    needs: frozenset[str]

    def reset(self, setup: TaskSetup) -> None: ...

    def depth(self, observation: Observation) -> Map:
        """For navigating: metres [H, W], infinite or NaN where nothing is known to be."""

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        """The thrown object, the gap or the pile; None where none is seen. ``exploring``: the gap's first phase."""


class PilotedMethod:
    """A perception under the pilots that all reference methods share."""

    def __init__(self, name: str, perception: Perception) -> None:
        self.name = name
        self.needs = perception.needs
        self.tasks = perception.tasks
        self._perception = perception

    def reset(self, setup: TaskSetup) -> None:
        """Start a trial.

        Raises:
            ValueError: the method does not do this task.
        """
        if setup.task not in self.tasks:
            raise ValueError(f"method '{self.name}' does not {setup.task}; it does: {', '.join(sorted(self.tasks))}")
        self._perception.reset(setup)
        self._task = setup.task
        self._navigate, self._gap, self._dodge = NavigatePilot(setup), GapPilot(setup), DodgePilot(setup)

    @property
    def baseline_m(self) -> float:
        """Of the second camera; for perceptions that need one."""
        return float(self._perception.baseline_m)  # type: ignore[attr-defined]

    def __call__(self, observation: Observation) -> Output:
        perception = self._perception
        if self._task == "navigate":
            return self._navigate(perception.depth(observation), observation)
        if self._task == "gap":
            exploring = self._gap.searching and self._gap.exploring(observation.frame.time_s)
            return self._gap(perception.mask(observation, exploring), observation)
        mask = perception.mask(observation, False)
        if self._task == "dodge":
            return self._dodge(mask, observation)
        return Output(mask, None, decided=mask is not None)


def largest_region(mask: Mask, least_px: int = 1) -> Mask | None:
    """The largest connected region (8 neighbours) of a mask, or None below ``least_px`` pixels."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return None
    areas = stats[1:, cv2.CC_STAT_AREA]
    best = int(areas.argmax())
    return labels == best + 1 if areas[best] >= least_px else None


def opened(mask: Mask, open_px: int, close_px: int) -> Mask:
    """Morphological opening, then closing, with discs of the given widths (0 or 1: none)."""
    import cv2

    image: Any = mask.astype(np.uint8)
    for kind, size in ((cv2.MORPH_OPEN, open_px), (cv2.MORPH_CLOSE, close_px)):
        if size > 1:
            image = cv2.morphologyEx(image, kind, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return image.astype(bool)
