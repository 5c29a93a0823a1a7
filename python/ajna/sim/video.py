# SPDX-License-Identifier: MIT
"""Videos of trials: what the camera saw, with mask and point, beside a view from outside."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from ajna import io
from ajna.sim.observation import Observation, Output
from ajna.sim.render import Renderer
from ajna.sim.worlds import World

__all__ = ["EpisodeVideo", "overlay"]

RgbImage = NDArray[np.uint8]
# distance in metres, azimuth and elevation in degrees, of the view from outside
_VIEWS = {
    "navigate": (3.2, 0.0, -22.0),
    "gap": (2.6, 35.0, -20.0),
    "dodge": (2.4, 25.0, -12.0),
    "pile": (1.1, 30.0, -40.0),
}
_ORANGE = np.array([255, 140, 0], np.float32)


def overlay(rgb: RgbImage, output: Output) -> RgbImage:
    """The picture with the mask tinted and outlined in orange and the point as a green cross."""
    blended = rgb.astype(np.float32)
    if output.mask is not None:
        mask = output.mask
        inner = mask.copy()
        inner[1:] &= mask[:-1]
        inner[:-1] &= mask[1:]
        inner[:, 1:] &= mask[:, :-1]
        inner[:, :-1] &= mask[:, 1:]
        blended[mask] = 0.75 * blended[mask] + 0.25 * _ORANGE
        blended[mask & ~inner] = _ORANGE
    picture = np.rint(blended).astype(np.uint8)
    if output.point_px is not None:
        height, width = picture.shape[:2]
        x, y = (round(v) for v in output.point_px)
        if 0 <= x < width and 0 <= y < height:
            picture[y, max(x - 6, 0) : x + 7] = (30, 255, 60)
            picture[max(y - 6, 0) : y + 7, x] = (30, 255, 60)
    return picture


class EpisodeVideo:
    """Records a trial: pass it as ``watch`` to run_episode, with its ``renderer``; leaving the block ends the file."""

    def __init__(self, world: World, path: Path) -> None:
        self._world = world
        path.parent.mkdir(parents=True, exist_ok=True)
        self.renderer = Renderer(world.model, world.camera)
        self._writer = io.VideoWriter(path, 2 * world.camera.width, world.camera.height, world.camera.rate_hz)

    def __enter__(self) -> EpisodeVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._writer.close()
        else:
            self._writer.discard()
        self.renderer.close()

    def __call__(self, observation: Observation, output: Output) -> None:
        """Add one frame."""
        camera = self._world.camera
        distance, azimuth, elevation = _VIEWS[self._world.task]
        frame = observation.frame
        target = frame.qpos[:3] + np.array([0.3, 0, 0]) if self._world.task != "pile" else np.zeros(3)
        # Not through the wall behind the start.
        level = np.cos(np.deg2rad(azimuth)) * np.cos(np.deg2rad(elevation))
        distance = min(distance, float(target[0] - self._world.bounds[0] - 0.15) / float(level))
        outside = self.renderer.outside(frame.qpos, target, distance, azimuth, elevation, (camera.width, camera.height))
        self._writer.write(np.concatenate([overlay(frame.rgb, output), outside], axis=1))
