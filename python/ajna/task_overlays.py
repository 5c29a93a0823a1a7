# SPDX-License-Identifier: MIT
"""Pictures of what the skills see and decide: RGB uint8 [H', W', 3], one per frame, frame and map side by side.

Left the frame, right the map of uncertainty, both with what was found drawn in; above, the status and the command.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.font_manager import findfont
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from ajna import viz
from ajna.tasks import Command, DodgeResult, GapResult, NavigateResult, SegmentResult

RgbImage = NDArray[np.uint8]
Color: TypeAlias = tuple[int, int, int]

RED, GREEN, YELLOW, CYAN, WHITE, ORANGE = (
    (255, 60, 60),
    (60, 255, 60),
    (255, 230, 0),
    (0, 230, 255),
    (255, 255, 255),
    (255, 150, 0),
)
_MIN_WIDTH = 480  # pixels of each panel: smaller frames are enlarged, so that lines and text are readable
_HEAD = 44


class _Panels:
    """Frame and map, enlarged alike, with drawing in frame coordinates on both."""

    def __init__(self, frame: RgbImage, uncertainty: ArrayLike | None, max_uncertainty: float | None) -> None:
        height, width = frame.shape[:2]
        self.scale = max(1, -(-_MIN_WIDTH // width))
        self.size = (width * self.scale, height * self.scale)
        pictures = [frame]
        if uncertainty is not None:
            pictures.append(viz.uncertainty_to_image(uncertainty, 0.0, max_uncertainty))
        self.panels = [Image.fromarray(picture).resize(self.size, Image.Resampling.BILINEAR) for picture in pictures]

    def at(self, point: ArrayLike) -> tuple[float, float]:
        x, y = np.clip((np.asarray(point, dtype=np.float64) + 0.5) * self.scale, -30000, 30000)
        return float(x), float(y)

    def _enlarged(self, mask: ArrayLike) -> NDArray[np.bool_]:
        image = Image.fromarray(np.asarray(mask, dtype=np.uint8))
        return np.asarray(image.resize(self.size, Image.Resampling.NEAREST)) > 0

    def outline(self, mask: ArrayLike | None, color: Color) -> None:
        if mask is not None:
            large = Image.fromarray(np.where(self._enlarged(mask), 255, 0).astype(np.uint8))
            rim = np.asarray(large.filter(ImageFilter.MaxFilter(3))) != np.asarray(
                large.filter(ImageFilter.MinFilter(3))
            )
            for panel in self.panels:
                panel.paste(color, mask=Image.fromarray(np.where(rim, 255, 0).astype(np.uint8)))

    def tint(self, mask: ArrayLike | None, color: Color) -> None:
        """On the frame alone."""
        if mask is not None:
            strength = np.where(self._enlarged(mask), 100, 0).astype(np.uint8)
            self.panels[0].paste(color, mask=Image.fromarray(strength))

    def line(self, points: Sequence[ArrayLike], color: Color, width: int = 2) -> None:
        for panel in self.panels:
            ImageDraw.Draw(panel).line([self.at(point) for point in points], fill=color, width=width)

    def polygon(self, points: ArrayLike, color: Color) -> None:
        corners = list(np.asarray(points))
        if corners:
            self.line([*corners, corners[0]], color)

    def box(self, box: tuple[int, int, int, int], color: Color) -> None:
        x, y, width, height = box
        if width and height:
            left, top, right, bottom = x - 0.5, y - 0.5, x + width - 0.5, y + height - 0.5
            self.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], color)

    def cross(self, point: ArrayLike, color: Color) -> None:
        x, y = np.asarray(point, dtype=np.float64)
        arm = 11 / self.scale
        self.line([(x - arm, y), (x + arm, y)], color, 3)
        self.line([(x, y - arm), (x, y + arm)], color, 3)

    def dots(self, points: ArrayLike, color: Color, everywhere: bool = False) -> None:
        for panel in self.panels if everywhere else self.panels[:1]:
            draw = ImageDraw.Draw(panel)
            for x, y in map(self.at, np.asarray(points)):
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=color)

    def arrow(self, begin: ArrayLike, end: ArrayLike, color: Color) -> None:
        first, last = np.asarray(begin, dtype=np.float64), np.asarray(end, dtype=np.float64)
        self.line([first, last], color, 3)
        length = np.linalg.norm(last - first)
        if length > 0:
            back = (first - last) / length * min(0.3 * length, 14 / self.scale)
            across = 0.6 * np.array([-back[1], back[0]])
            self.line([last + back + across, last, last + back - across], color, 3)

    def picture(self, *lines: str) -> RgbImage:
        width = self.size[0] * len(self.panels)
        sheet = Image.new("RGB", (width, self.size[1] + _HEAD), (24, 24, 24))
        for index, panel in enumerate(self.panels):
            sheet.paste(panel, (index * self.size[0], _HEAD))
        draw, font = ImageDraw.Draw(sheet), ImageFont.truetype(findfont("DejaVu Sans"), 14)
        for row, line in enumerate(lines):
            draw.text((8, 4 + 19 * row), line, fill=WHITE, font=font)
        return np.asarray(sheet)


def _command(command: Command | None) -> str:
    if command is None:
        return ""
    if command.mode == "hold":
        return "command: hold"
    vector = command.acceleration_m_s2 if command.mode == "acceleration" else command.velocity_m_s
    unit = "m/s2" if command.mode == "acceleration" else "m/s"
    parts = " ".join(f"{value:+.1f}" for value in vector)
    turn = f", yaw {command.yaw_rate_rad_s:+.2f} rad/s" if command.yaw_rate_rad_s else ""
    return f"command: {command.mode} {parts} {unit} (forward right down){turn}"


def dodge_overlay(
    frame: RgbImage,
    uncertainty: ArrayLike,
    result: DodgeResult,
    command: Command | None = None,
    max_uncertainty: float | None = None,
    outline: NDArray[np.bool_] | None = None,
) -> RgbImage:
    """Obstacle outlined in red, its track in yellow, impact as an orange cross, safe direction as a green arrow.

    outline: of a closer look (:meth:`ajna.tasks.Skill.outline`), in cyan.
    """
    panels = _Panels(frame, uncertainty, max_uncertainty)
    panels.outline(result.mask, RED)
    panels.outline(outline, CYAN)
    panels.dots([point.center_px for point in result.track], YELLOW, everywhere=True)
    for before, after in zip(result.track, result.track[1:], strict=False):
        panels.arrow(before.center_px, after.center_px, YELLOW)
    text = f"dodge: {result.status.replace('_', ' ')}"
    if result.safe_direction is not None:
        height, width = frame.shape[:2]
        center = np.array([(width - 1) / 2, (height - 1) / 2])
        panels.cross(result.impact_px, ORANGE)
        panels.arrow(center, center + 0.3 * height * result.safe_direction, GREEN)
        source = "growth" if result.contact_from_growth else "assumed"
        text += f", contact in {result.time_to_contact_s:.2f} s ({source})"
    return panels.picture(text, _command(command))


def navigate_overlay(
    frame: RgbImage,
    uncertainty: ArrayLike,
    result: NavigateResult,
    command: Command | None = None,
    max_uncertainty: float | None = None,
) -> RgbImage:
    """Free space in green with its safe point, neighbourhood in white, goal in cyan, what is near in red and orange."""
    panels = _Panels(frame, uncertainty, max_uncertainty)
    text = f"navigate: {result.status.replace('_', ' ')}"
    if result.status in ("ok", "blocked"):
        panels.tint(result.free.mask, GREEN)
        panels.box(result.window, WHITE)
        panels.box(result.close_box, RED)
        panels.box(result.other_box, ORANGE)
        panels.cross(result.goal_px, CYAN)
        if result.status == "ok":
            panels.cross(result.free_px, GREEN)
            panels.arrow(result.goal_px, result.goal_px + result.weight * (result.free_px - result.goal_px), YELLOW)
        text += (
            f", w = {result.weight:.2f}, Y near {result.y_close:.2f} / {result.y_other:.2f}, free {result.y_free:.2f}"
        )
    return panels.picture(text, _command(command))


def gap_overlay(
    frame: RgbImage,
    uncertainty: ArrayLike | None,
    result: GapResult,
    command: Command | None = None,
    max_uncertainty: float | None = None,
) -> RgbImage:
    """Contour in red, safe point in green, features of the wall in cyan and of the background in yellow."""
    panels = _Panels(frame, uncertainty, max_uncertainty)
    text = f"gap: {result.status.replace('_', ' ')}"
    if result.status == "exploring":
        text += f", {result.pairs} pairs stacked"
    if len(result.contour):
        panels.polygon(result.contour, RED)
        panels.dots(result.foreground, CYAN)
        panels.dots(result.background, YELLOW)
        text += f" by the {result.side}"
        if result.focus_px is not None:
            panels.cross(result.focus_px, ORANGE)
    if result.status == "tracking":
        panels.cross(result.safe_px, GREEN)
        x, y = result.safe_offset
        text += f", safe point {x:+.2f} {y:+.2f} focal lengths off"
    return panels.picture(text, _command(command))


def segment_overlay(
    frame: RgbImage, uncertainty: ArrayLike, result: SegmentResult, max_uncertainty: float | None = None
) -> RgbImage:
    """Attention outlined in yellow (from the uncertainty alone), the segmentation seeded by it tinted green."""
    panels = _Panels(frame, uncertainty, max_uncertainty)
    panels.tint(result.segmentation, GREEN)
    panels.outline(result.attention, YELLOW)
    return panels.picture(f"segment: {result.status.replace('_', ' ')}", "yellow: attention   green: segmentation")


def steps_picture(steps: Any, frame: RgbImage | None = None) -> RgbImage:
    """The intermediates of a map side by side: scalar map, normalised, above the threshold, after morphology."""
    images = [] if frame is None else [frame]
    for values in (steps.scalar, steps.normalized):
        if values is not None:
            images.append(viz.uncertainty_to_image(values, float(np.min(values))))
    for mask in (steps.raw_mask, steps.mask):
        if mask is not None:
            images.append(np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
    if not images:
        raise ValueError(f"the map's status is '{steps.status}': there are no intermediates to show")
    return np.concatenate(images, axis=1)
