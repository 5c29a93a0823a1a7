# SPDX-License-Identifier: MIT
"""ajna.viz: colours against a scalar reference of the Middlebury code, layouts, no global state."""

from __future__ import annotations

import colorsys
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from ajna import viz

HEIGHT, WIDTH = 30, 40


def reference_color(u: float, v: float) -> tuple[int, int, int]:
    """Middlebury's computeColor for one vector of length <= 1, written as loops."""
    wheel: list[list[float]] = []
    channels = [255.0, 0.0, 0.0]
    # (steps, channel that changes, direction): red-yellow-green-cyan-blue-magenta-red
    for steps, channel, sign in ((15, 1, 1), (6, 0, -1), (4, 2, 1), (11, 1, -1), (13, 0, 1), (6, 2, -1)):
        for i in range(steps):
            color = list(channels)
            color[channel] = 255.0 * i / steps if sign > 0 else 255.0 - 255.0 * i / steps
            wheel.append(color)
        channels[channel] = 255.0 if sign > 0 else 0.0
    angle = math.atan2(-v, -u) / math.pi
    position = (angle + 1) / 2 * (len(wheel) - 1)
    first = int(position)
    second = (first + 1) % len(wheel)
    part = position - first
    radius = math.hypot(u, v)
    mixed = [(1 - part) * wheel[first][c] + part * wheel[second][c] for c in range(3)]
    return tuple(int(255 - radius * (255 - value) + 1e-6) for value in mixed)  # type: ignore[return-value]


def test_flow_colors_equal_the_scalar_reference() -> None:
    random = np.random.default_rng(0)
    angle, radius = random.uniform(-np.pi, np.pi, 200), random.uniform(0, 1, 200)
    flow = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)[None]
    image = viz.flow_to_image(flow * 7.5, max_flow=7.5)[0]
    expected = [reference_color(u, v) for u, v in flow[0]]
    assert np.abs(image.astype(int) - expected).max() <= 1


def test_directions_have_the_known_hues() -> None:
    # Middlebury: right is red, down yellow(ish), left cyan, up blue/violet; still is white; unknown is black.
    flow = np.array([[[1, 0], [0, 1], [-1, 0], [0, -1], [0, 0], [np.nan, 0], [1e10, 0]]], dtype=np.float32)
    image = viz.flow_to_image(flow, max_flow=1.0)[0]
    hues = [colorsys.rgb_to_hsv(*(color / 255.0))[0] * 360 for color in image[:4]]
    assert hues[0] < 10 or hues[0] > 350
    assert 40 < hues[1] < 75
    assert 165 < hues[2] < 195
    assert 235 < hues[3] < 290
    assert image[4].tolist() == [255, 255, 255]
    assert image[5].tolist() == image[6].tolist() == [0, 0, 0]


def test_scale_is_fixed_or_robust_and_overflow_is_darker() -> None:
    flow = np.zeros((HEIGHT, WIDTH, 2))
    flow[..., 0] = 2.0
    flow[0, 0, 0] = 500.0  # one outlier must not wash the picture out
    assert np.array_equal(viz.flow_to_image(flow)[1:], viz.flow_to_image(flow, max_flow=2.0)[1:])
    assert viz.flow_to_image(flow)[0, 0].sum() < viz.flow_to_image(flow)[1, 1].sum()
    assert viz.flow_to_image(flow, max_flow=8.0)[1, 1].min() > viz.flow_to_image(flow, max_flow=4.0)[1, 1].min()
    with pytest.raises(ValueError, match="max_flow=0"):
        viz.flow_to_image(flow, max_flow=0)


@pytest.mark.parametrize("largest", [1e-9, 0.0123, 0.99, 1.0, 1.01, 7.2, 9.5, 132.5])
def test_nice_scale_covers_and_stays_near(largest: float) -> None:
    scale = viz.nice_scale(largest)
    assert largest <= scale * (1 + 1e-6) and scale <= 2.001 * largest
    assert viz.nice_scale(scale) == pytest.approx(scale)


def test_scales_of_nothing_are_one() -> None:
    assert viz.robust_scale(np.zeros((3, 3))) == viz.robust_scale(np.full((3, 3), np.nan)) == 1.0
    assert viz.nice_scale(math.inf) == 1.0


def test_low_uncertainty_is_blue_and_high_is_yellow() -> None:
    image = viz.uncertainty_to_image(np.array([[0.0, 2.0, 1e6, np.inf]]), vmin=0.0, vmax=2.0)[0]
    red, green, blue = (image[:, channel].astype(int) for channel in range(3))
    assert blue[0] > 2 * max(red[0], green[0])  # dark blue
    assert min(red[1], green[1]) > 2 * blue[1]  # yellow
    assert image[1].tolist() == image[2].tolist() and image[3].tolist() == [0, 0, 0]


def test_per_axis_uncertainty_is_shown_as_its_norm() -> None:
    values = np.random.default_rng(1).uniform(0, 3, (HEIGHT, WIDTH, 2))
    norm = np.hypot(values[..., 0], values[..., 1])
    assert np.array_equal(viz.uncertainty_to_image(values, 0, 4), viz.uncertainty_to_image(norm, 0, 4))
    with pytest.raises(ValueError, match=r"vmax=0.0 must lie above vmin=1.0"):
        viz.uncertainty_to_image(norm, 1.0, 0.0)
    assert viz.uncertainty_to_image(np.zeros((2, 2))).shape == (2, 2, 3)


def make_scene(height: int = HEIGHT, width: int = WIDTH) -> dict:
    random = np.random.default_rng(2)
    frame = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    flow = random.normal(0, 2, (height, width, 2)).astype(np.float32)
    truth = flow + random.normal(0, 0.3, flow.shape).astype(np.float32)
    truth[:5] = np.nan
    field = SimpleNamespace(flow=flow, expected_error=np.abs(flow) / 5)
    return {"frame1": frame, "frame2": np.roll(frame, 2, axis=1), "field": field, "truth": truth}


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (24, 90), (64, 32)])
@pytest.mark.parametrize("with_truth", [False, True])
def test_overview_is_an_rgb_picture_that_holds_the_panels(size: tuple[int, int], with_truth: bool) -> None:
    scene = make_scene(*size)
    truth = scene["truth"] if with_truth else None
    image = viz.overview(scene["frame1"], scene["frame2"], scene["field"], truth, title="a title")
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    assert np.array_equal(image, viz.overview(scene["frame1"], scene["frame2"], scene["field"], truth, title="a title"))
    plain = viz.overview(scene["frame1"], scene["frame2"], scene["field"], truth)
    assert plain.shape[0] < image.shape[0] and plain.shape[1] == image.shape[1]
    border = np.concatenate([image[:4].ravel(), image[-4:].ravel(), image[:, :4].ravel(), image[:, -3:].ravel()])
    assert (border == 255).all()  # nothing is cut off at the edges


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (24, 90), (90, 24)])
def test_no_text_overlaps_or_leaves_the_picture(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    canvases = []
    draw = viz._Canvas.rgb
    monkeypatch.setattr(viz._Canvas, "rgb", lambda self: (canvases.append(self), draw(self))[1])
    scene = make_scene(*size)
    long = {"title": "a very long title " * 12, "error_label": "a label that is longer than usual"}
    viz.overview(scene["frame1"], scene["frame2"], scene["field"], scene["truth"], **long)
    figure = canvases[0].figure
    ticks = [label for axes in figure.axes for label in axes.get_yticklabels() if axes.axison]
    boxes = [text.get_window_extent() for text in [*figure.texts, *ticks]]
    for index, box in enumerate(boxes):
        assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0 and box.y1 <= figure.bbox.height
        assert not any(box.overlaps(other) for other in boxes[index + 1 :])


def test_overview_shows_flow_and_error_in_their_colors() -> None:
    scene = make_scene()
    scene["field"].flow = np.full((HEIGHT, WIDTH, 2), (3.0, 0.0), np.float32)
    scene["field"].expected_error = np.full((HEIGHT, WIDTH, 2), (0.3, 0.4), np.float32)
    image = viz.overview(scene["frame1"], scene["frame2"], scene["field"], max_flow=3.0, max_error=0.5)
    pixels = image.reshape(-1, 3)
    for color in (viz.flow_to_image([[[3.0, 0.0]]], 3.0), viz.uncertainty_to_image([[0.5]], 0, 0.5)):
        share = (pixels == color.reshape(3)).all(axis=1).sum()
        assert share > 0.9 * 480 * 360


def test_anaglyph_of_equal_frames_is_grey() -> None:
    frame = make_scene()["frame1"]
    image = viz.anaglyph(frame, frame)
    assert (image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all()
    assert abs(int(viz.anaglyph(np.full_like(frame, 255), frame)[..., 0].min()) - 255) <= 0


def test_wrong_inputs_are_named() -> None:
    scene = make_scene()
    with pytest.raises(ValueError, match=r"frame2 is \(29, 40\)"):
        viz.overview(scene["frame1"], scene["frame2"][1:], scene["field"])
    with pytest.raises(ValueError, match=r"ground_truth is \(30, 39\)"):
        viz.overview(scene["frame1"], scene["frame2"], scene["field"], scene["truth"][:, 1:])
    with pytest.raises(ValueError, match="frame1 has shape .* float64; pass RGB uint8"):
        viz.overview(scene["frame1"] / 255.0, scene["frame2"], scene["field"])
    with pytest.raises(ValueError, match=r"flow has shape \(30, 40\)"):
        viz.flow_to_image(np.zeros((30, 40)))


def test_sparsification_plot() -> None:
    removed = np.linspace(0, 1, 51)
    curves = {"model": viz.Curve(1 - removed**2, 1 - removed, 0.17), "other": viz.Curve(1 + removed, 1 - removed, 1.0)}
    image = viz.sparsification_plot(curves, title="pairs")
    assert image.dtype == np.uint8 and image.shape[2] == 3 and len(np.unique(image.reshape(-1, 3), axis=0)) > 10


def test_import_and_use_leave_pyplot_alone() -> None:
    code = (
        "import sys, numpy as np\n"
        "from ajna import viz\n"
        "viz.sparsification_plot({'a': viz.Curve([1, 0], [1, 0], 0.0)})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
