# SPDX-License-Identifier: MIT
"""What disturbs optical flow beside motion: lamps, low texture, exposure, noise, blur, rain, patches in the picture.

Each disturbance takes a :class:`StudyScene` and gives the pair as a camera would have seen it, with a mask of the
pixels that it touched where it does not touch all of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ajna import synth
from ajna.data.synthetic import _seed as held_out_seed

__all__ = ["DISTURBANCES", "SCENARIOS", "Patch", "StudyScene", "disturbed", "make_scene", "with_patch"]

Frame = NDArray[np.uint8]
Mask = NDArray[np.bool_]

#: The paper's three scenarios, as presets of :mod:`ajna.synth`: unknown gaps, static obstacles, dynamic obstacles.
SCENARIOS = ("gap", "navigate", "dodge")
#: Scenes come without disturbances of their own.
_PLAIN = {
    "noise_max": 0.0, "brightness_change": 0.0, "color_change": 0.0, "gamma_change": 0.0, "blur_probability": 0.0,
    "defocus_probability": 0.0, "blink_probability": 0.0, "light_probability": 0.0, "jump_probability": 0.0,
    "flat_texture_share": 0.0, "repetitive_texture_share": 0.0, "texture_size": 192, "bank_size": 4,
}  # fmt: skip


@dataclass(frozen=True)
class StudyScene:
    """A pair with its truth, of textures that no other scene has.

    frame1, frame2: RGB uint8 [H, W, 3]. boundary: bool [H, W], motion boundaries of frame 1 (and where the scene stands
    still: of the moving scene it was taken from). occluded: bool [H, W]. layer1, layer2: int [H, W], which surface is
    seen in either frame. touched: bool [H, W], what a local disturbance covers; None: all or nothing.
    """

    number: int
    frame1: Frame
    frame2: Frame
    boundary: Mask
    occluded: Mask
    layer1: NDArray[np.uint8]
    layer2: NDArray[np.uint8]
    touched: Mask | None = None


def make_scene(number: int, seed: int, width: int = 320, height: int = 240) -> StudyScene:
    """Scene ``number`` of a study: scenarios take turns, each scene has a texture bank of its own.

    Seeds are kept apart from those of training. Scenes with hardly any boundary are drawn again.
    """
    options = {**_PLAIN, "preset": SCENARIOS[number % len(SCENARIOS)]}
    generator = synth.PairGenerator(options, bank_seed=held_out_seed(seed, 2 * number))
    for attempt in range(20):
        pairs = generator(1, height, width, seed=held_out_seed(seed, 2 * number + 1) + attempt)
        if int(pairs.motion_boundary.sum()) >= 150:
            break
    return StudyScene(
        number,
        *(frame[0].permute(1, 2, 0).contiguous().numpy() for frame in (pairs.frame1, pairs.frame2)),
        *(mask[0, 0].numpy() for mask in (pairs.motion_boundary, pairs.occlusion, pairs.layer1, pairs.layer2)),
    )


def _uint8(values: NDArray[np.floating]) -> Frame:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _disc(shape: tuple[int, ...], center: NDArray[np.floating], radius: float) -> NDArray[np.float64]:
    """A soft disc: 1 inside, falling to 0 over a third of the radius."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    distance = np.hypot(columns - center[0], rows - center[1])
    return np.clip((1.33 * radius - distance) / (0.33 * radius), 0, 1)


def _still(scene: StudyScene) -> StudyScene:
    return replace(scene, frame2=scene.frame1, occluded=np.zeros_like(scene.occluded), layer2=scene.layer1)


def _lamp(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """A lamp of 4 to 10 % of the image's height that is on in the second frame only."""
    height, width = scene.boundary.shape
    center = random.uniform([0.15 * width, 0.15 * height], [0.85 * width, 0.85 * height])
    glow = _disc(scene.boundary.shape, center, random.uniform(0.04, 0.10) * height)
    color = random.uniform(150, 255, 3)
    lit = scene.frame2 + glow[..., None] * np.maximum(color - scene.frame2 * 0.5, 0)
    return replace(scene, frame2=_uint8(lit), touched=glow > 0)


def _rain(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """Bright streaks, 250 to 400 in each frame, of 8 to 22 pixels, all leaning one way, anew in either frame."""
    import cv2

    height, width = scene.boundary.shape
    lean = random.uniform(-0.3, 0.3)
    frames = []
    for frame in (scene.frame1, scene.frame2):
        drawn = np.zeros((height, width), np.uint8)
        for _ in range(int(random.integers(250, 400))):
            x, y, length = random.uniform(0, width), random.uniform(-20, height), random.uniform(8, 22)
            end = (round(x + lean * length), round(y + length))
            cv2.line(drawn, (round(x), round(y)), end, int(random.integers(60, 140)), 1, cv2.LINE_AA)
        frames.append(_uint8(frame + 0.7 * drawn[..., None].astype(np.float64)))
    return replace(scene, frame1=frames[0], frame2=frames[1])


def _low_texture(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """The contrast within each surface falls to a tenth; its mean colour stays."""
    frames = [scene.frame1.astype(np.float64), scene.frame2.astype(np.float64)]
    faint = [frame.copy() for frame in frames]
    for layer in np.unique(scene.layer1):
        first, second = scene.layer1 == layer, scene.layer2 == layer
        mean = frames[0][first].mean(axis=0)
        for frame, pale, here in zip(frames, faint, (first, second), strict=True):
            pale[here] = mean + 0.1 * (frame[here] - mean)
    return replace(scene, frame1=_uint8(faint[0]), frame2=_uint8(faint[1]))


def _brightness(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """The second frame's exposure jumps by one stop, up or down."""
    gain = 2.0 if random.random() < 0.5 else 0.5
    return replace(scene, frame2=_uint8(scene.frame2 * gain))


def _noise(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """Gaussian noise of 15 grey levels in either frame."""
    noisy = [_uint8(f + random.normal(0, 15, f.shape)) for f in (scene.frame1, scene.frame2)]
    return replace(scene, frame1=noisy[0], frame2=noisy[1])


def _blur(scene: StudyScene, random: np.random.Generator) -> StudyScene:
    """Both frames out of focus: a Gaussian of 2.5 pixels."""
    import cv2

    first, second = (np.asarray(cv2.GaussianBlur(f, (0, 0), 2.5), np.uint8) for f in (scene.frame1, scene.frame2))
    return replace(scene, frame1=first, frame2=second)


#: Name -> what it does to a scene; the first leaves it as it is.
DISTURBANCES: dict[str, Callable[[StudyScene, np.random.Generator], StudyScene]] = {
    "clean": lambda scene, random: scene,
    "still": lambda scene, random: _still(scene),
    "lamp, still": lambda scene, random: _lamp(_still(scene), random),
    "lamp, moving": _lamp,
    "low texture": _low_texture,
    "brightness jump": _brightness,
    "noise": _noise,
    "blur": _blur,
    "rain": _rain,
}


def disturbed(scene: StudyScene, name: str, seed: int) -> StudyScene:
    """A scene under a disturbance of DISTURBANCES; equal seeds, equal pictures."""
    return DISTURBANCES[name](scene, np.random.default_rng([seed, scene.number, zlib.crc32(name.encode())]))


@dataclass(frozen=True)
class Patch:
    """A square picture that somebody holds before the camera: RGB uint8 [S, S, 3]."""

    image: Frame

    @property
    def side(self) -> int:
        """Pixels."""
        return self.image.shape[0]

    def place(self, scene: StudyScene, seed: int) -> tuple[int, int]:
        """(x, y) of its upper left corner in a scene; the same for every patch of one size."""
        random = np.random.default_rng([seed, scene.number, 0x9A7C])
        height, width = scene.boundary.shape
        return int(random.integers(0, width - self.side + 1)), int(random.integers(0, height - self.side + 1))


def with_patch(scene: StudyScene, patch: Patch, seed: int) -> StudyScene:
    """The patch at one place in both frames, as if fixed to the camera; boundaries under it do not count."""
    x, y = patch.place(scene, seed)
    box = np.s_[y : y + patch.side, x : x + patch.side]
    frames = [scene.frame1.copy(), scene.frame2.copy()]
    for frame in frames:
        frame[box] = patch.image
    touched = np.zeros_like(scene.boundary)
    touched[box] = True
    return replace(scene, frame1=frames[0], frame2=frames[1], boundary=scene.boundary & ~touched, touched=touched)
