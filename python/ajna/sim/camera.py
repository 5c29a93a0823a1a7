# SPDX-License-Identifier: MIT
"""The simulated camera: intrinsics, motion blur, sensor noise, exposure drift, and what it truly saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ajna.sim.render import Renderer

__all__ = ["CameraModel", "Frame", "add_sensor_noise", "exposure_gain"]

RgbImage = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CameraModel:
    """A pinhole camera without distortion. Pixel (0, 0) is the centre of the upper left pixel.

    The picture is rendered at ``render_scale`` times the size and reduced by averaging (640x480 -> 320x240).
    """

    width: int = 320
    height: int = 240
    horizontal_fov_rad: float = np.deg2rad(80.0)
    render_scale: int = 2
    rate_hz: float = 30.0
    exposure_steps: int = 6  # physics steps (1/600 s) during which the shutter is open
    subframes: int = 3  # pictures averaged over the exposure; odd: the middle one is the frame's true state
    read_noise: float = 1.2  # grey levels (standard deviation) in the dark
    shot_noise: float = 0.18  # grey levels per square root of a grey level
    exposure_drift: float = 0.04  # standard deviation of the slow change of the gain

    @property
    def focal_px(self) -> float:
        return self.width / 2 / float(np.tan(self.horizontal_fov_rad / 2))

    @property
    def center_px(self) -> tuple[float, float]:
        return (self.width - 1) / 2, (self.height - 1) / 2

    @property
    def vertical_fov_rad(self) -> float:
        return 2 * float(np.arctan(self.height / 2 / self.focal_px))

    def matrix(self) -> Floats:
        """The intrinsics K, float64 [3, 3]."""
        cx, cy = self.center_px
        return np.array([[self.focal_px, 0, cx], [0, self.focal_px, cy], [0, 0, 1]])

    @cached_property
    def rays(self) -> Floats:
        """The direction of each pixel at depth 1, camera frame, float64 [H, W, 3]."""
        cx, cy = self.center_px
        x = (np.arange(self.width) - cx) / self.focal_px
        y = (np.arange(self.height) - cy) / self.focal_px
        xx, yy = np.meshgrid(x, y)
        return np.stack([xx, yy, np.ones_like(xx)], axis=-1)

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels [..., 2] and depths [...] of points [..., 3] in the camera frame; pixels are NaN behind the camera."""
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(z[..., None] > 1e-6, points[..., :2] / z[..., None], np.nan)
        return xy * self.focal_px + np.array(self.center_px), z


def exposure_gain(camera: CameraModel, seed: int, time_s: float) -> float:
    """The gain of the automatic exposure: three slow sine waves about 1 whose phases come from ``seed``."""
    random = np.random.default_rng([seed, 0x6A1])
    periods, phases = random.uniform(0.8, 5.0, 3), random.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * time_s / periods + phases)
    return float(np.exp(camera.exposure_drift * waves.sum() * np.sqrt(2 / 3)))


def add_sensor_noise(image: Floats, camera: CameraModel, gain: float, random: np.random.Generator) -> RgbImage:
    """Grey levels [H, W, 3] -> uint8 [H, W, 3] after gain, shot and read noise, and rounding."""
    bright = image * gain
    sigma = np.sqrt(camera.read_noise**2 + camera.shot_noise**2 * bright)
    noisy = bright + sigma * random.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


class Frame:
    """One exposure. Pictures, depth and segmentation are rendered when they are first asked for.

    Args:
        renderer: of the world the frame was taken in.
        states: the generalised positions during the exposure, in time order; the middle one is the true state.
        index: number of the frame; time_s: of the middle of its exposure; seed: of noise and exposure drift.
    """

    def __init__(
        self, renderer: Renderer, states: Sequence[NDArray[np.float64]], index: int, time_s: float, seed: int
    ) -> None:
        self._renderer = renderer
        self._states = [np.array(state) for state in states]
        self.index = index
        self.time_s = time_s
        self.seed = seed
        self.camera = renderer.camera
        self._right: dict[float, RgbImage] = {}

    @property
    def qpos(self) -> NDArray[np.float64]:
        """The true state of the world: MuJoCo's generalised positions."""
        return self._states[len(self._states) // 2]

    @cached_property
    def poses(self) -> tuple[Floats, Floats, Floats]:
        """T_world_camera [4, 4]; position [B, 3] and rotation [B, 3, 3] of each body in the world."""
        return self._renderer.poses(self.qpos)

    @property
    def T_world_camera(self) -> Floats:
        return self.poses[0]

    @cached_property
    def _depth_and_geom(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        return self._renderer.depth_and_geom(self.qpos)

    @property
    def depth(self) -> NDArray[np.float32]:
        """True depth along the optical axis in metres, float32 [H, W]; infinite in the sky."""
        return self._depth_and_geom[0]

    @property
    def geom(self) -> NDArray[np.int32]:
        """The number of MuJoCo's geom seen at each pixel, int32 [H, W]; -1 in the sky."""
        return self._depth_and_geom[1]

    @cached_property
    def body(self) -> NDArray[np.int32]:
        """The number of MuJoCo's body seen at each pixel, int32 [H, W]; -1 in the sky."""
        bodies = np.append(self._renderer.model.geom_bodyid, -1).astype(np.int32)
        return bodies[self.geom]

    @cached_property
    def clean(self) -> RgbImage:
        """The picture without noise, drift and blur, RGB uint8 [H, W, 3]."""
        return np.rint(self._renderer.color(self.qpos)).astype(np.uint8)

    @cached_property
    def rgb(self) -> RgbImage:
        """What the sensor delivers, RGB uint8 [H, W, 3]."""
        return self._sensed(None)

    def right(self, baseline_m: float) -> RgbImage:
        """What a second camera delivers, ``baseline_m`` to the right, RGB uint8 [H, W, 3]."""
        if baseline_m not in self._right:
            self._right[baseline_m] = self._sensed(baseline_m)
        return self._right[baseline_m]

    def _sensed(self, baseline_m: float | None) -> RgbImage:
        blurred = np.mean([self._renderer.color(state, baseline_m or 0.0) for state in self._states], axis=0)
        stream = 0 if baseline_m is None else 1
        random = np.random.default_rng([self.seed, self.index, stream])
        return add_sensor_noise(blurred, self.camera, exposure_gain(self.camera, self.seed, self.time_s), random)
