# SPDX-License-Identifier: MIT
"""The four skills from Python: true signals of rendered scenes, maps without content, overlays."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.typing import NDArray

io = pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna import synth, task_overlays, tasks  # noqa: E402

SIZE = (240, 320)
FRAME = 1 / 30


def calm(level: float = 0.3) -> NDArray[np.float32]:
    return np.random.default_rng(0).uniform(level - 0.02, level + 0.02, SIZE).astype(np.float32)


def disc(center: tuple[float, float], radius: float) -> NDArray[np.bool_]:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.hypot(x - center[0], y - center[1]) <= radius


def with_disc(center: tuple[float, float], radius: float, level: float = 1.6) -> NDArray[np.float32]:
    return np.where(disc(center, radius), np.float32(level), calm())


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


# --- true signals ----------------------------------------------------------------------------------------------------


def true_signal(batch: synth.PairBatch, index: int) -> NDArray[np.float32]:
    """What a perfect network is uncertain of: occluded pixels, and the motion boundary with its neighbours."""
    rim = batch.motion_boundary[index, 0].numpy()
    padded = np.pad(rim, 2)
    wide = np.zeros_like(rim)
    for dy in range(5):
        for dx in range(5):
            wide |= padded[dy : dy + rim.shape[0], dx : dx + rim.shape[1]]
    return np.where(batch.occlusion[index, 0].numpy() | wide, 1.5, 0.2).astype(np.float32)


def scenes(layers: int, count: int, seed: int) -> synth.PairBatch:
    """A small moving thing (or none) before a background that stands still."""
    options = {
        "layers": layers,
        "layer_probability": 1.0,
        "min_size": 0.08,
        "max_size": 0.2,
        "bar_weight": 0.0,
        "plate_weight": 0.0,
        "static_probability": 1.0,
        "attached_probability": 0.0,
        "parallax_probability": 0.0,
        "flow_distribution": "uniform",
        "flow_max_px": 14.0,
        "bank_size": 8,
        "texture_size": 128,
    }
    return synth.PairGenerator(options)(count, *SIZE, seed=seed)


def test_dodge_finds_what_moves_in_rendered_scenes_by_the_true_signal() -> None:
    batch = scenes(layers=1, count=16, seed=3)
    found, moving = 0, 0
    for index in range(16):
        truth = batch.layer1[index, 0].numpy() > 0
        speed = batch.flow[index].norm(dim=0).numpy()[truth]
        if truth.sum() < 150 or speed.mean() < 2:
            continue  # left the image, or as good as still
        moving += 1
        result = tasks.DodgePipeline().step(true_signal(batch, index), 0.0)
        found += result.mask is not None and iou(result.mask, truth) >= 0.5
    assert moving >= 8
    assert found >= 0.85 * moving, f"{found} of {moving}"


def test_dodge_sees_nothing_in_rendered_scenes_without_motion() -> None:
    batch = scenes(layers=0, count=4, seed=5)
    for index in range(4):
        result = tasks.DodgePipeline().step(true_signal(batch, index), 0.0)
        assert result.status == "no_obstacle"
        assert result.mask is None and result.safe_direction is None


# --- the pipelines through the bindings ------------------------------------------------------------------------------


def test_dodge_over_three_frames_commands_the_other_way() -> None:
    pipeline, policy = tasks.DodgePipeline(), tasks.DodgePolicy()
    modes = []
    for index in range(3):
        result = pipeline.step(with_disc((120 + 6 * index, 120), 12 + index), index * FRAME)
        command = policy.update(result.safe_direction, index * FRAME)
        modes.append((result.status, command.mode))
    assert modes == [("detected", "hold"), ("detected", "hold"), ("incoming", "acceleration")]
    assert command.velocity_m_s[1] == pytest.approx(-tasks.DodgePolicyOptions().speed_m_s, rel=0.05)
    assert [point.time_s for point in result.track] == pytest.approx([0, FRAME, 2 * FRAME])
    assert json.loads(json.dumps(tasks.command_dict(command)))["mode"] == "acceleration"


def test_navigate_goes_round_and_guides_the_policy() -> None:
    uncertainty = calm()
    uncertainty[:, 130:160] = 2.0
    result = tasks.NavigatePipeline().step(uncertainty, 0.0)
    assert result.status == "ok" and result.free_px[0] > 160 and 0 < result.weight < 1
    command = tasks.NavigatePolicy().update(tasks.guidance(result), 0.0)
    assert command.mode == "acceleration" and command.yaw_rate_rad_s > 0
    wall = tasks.NavigatePipeline().step(np.full(SIZE, 9, np.float32), 0.0)
    assert wall.status == "blocked" and tasks.guidance(wall) is None
    assert tasks.NavigatePolicy().update(None, 0.0).mode == "hold"


@pytest.mark.parametrize("rule", ["limits", "rescaled", "printed"])
def test_weight_rules(rule: str) -> None:
    nothing, near = (tasks.navigation_weight(y, 0.3, 0.3, rule) for y in (0.3, 6.0))
    assert near > 0.9 > nothing
    assert (nothing == pytest.approx(0)) == (rule != "printed")


def test_gap_in_a_map_and_segmentation_of_a_pile() -> None:
    gap = tasks.detect_gap(with_disc((170, 110), 45, 0.9))
    assert gap.found and iou(gap.mask, disc((170, 110), 45)) > 0.8
    assert np.allclose(gap.safe_px, (170, 110), atol=2)
    frame = np.full((*SIZE, 3), (60, 120, 90), np.uint8)
    pile = disc((160, 120), 40)
    frame[pile] = (200, 80, 40)
    rim = disc((160, 120), 45) & ~disc((160, 120), 34)
    result = tasks.segment_pile(frame, np.where(rim, np.float32(1.2), calm()))
    assert result.status == "ok"
    assert iou(result.segmentation, pile) > 0.95 > iou(result.attention, pile) > 0.6
    assert set(np.unique(result.seeds)) == {0, 128, 255}


def test_per_axis_maps_are_reduced_as_the_options_say() -> None:
    field = np.stack([with_disc((100, 80), 20, 3.0), calm()], axis=-1)
    options = tasks.MapOptions()
    norm = tasks.find_regions(field, options)
    np.testing.assert_allclose(
        norm.scalar, tasks.find_regions(np.hypot(*np.moveaxis(field, 2, 0)), options).scalar, atol=1e-5
    )
    options.scalar = "y"
    assert tasks.find_regions(field, options).scalar.max() < 0.4


@pytest.mark.parametrize(
    "uncertainty",
    [
        np.zeros((0, 0), np.float32),
        np.ones((1, 1), np.float32),
        np.full(SIZE, np.nan, np.float32),
        np.full(SIZE, np.inf, np.float32),
        np.full(SIZE, -1, np.float32),
    ],
    ids=["empty", "one pixel", "NaN", "infinite", "negative"],
)
def test_unusable_maps_have_a_safe_answer_each(uncertainty: NDArray[np.float32]) -> None:
    assert tasks.find_regions(uncertainty).status == "invalid_input"
    assert tasks.DodgePipeline().step(uncertainty, 0.0).status == "invalid_input"
    assert tasks.NavigatePipeline().step(uncertainty, 0.0).status == "invalid_input"
    assert not tasks.detect_gap(uncertainty).found
    frame = np.zeros((*SIZE, 3), np.uint8)
    assert tasks.segment_pile(frame, uncertainty).status == "invalid_input"
    pipeline = tasks.GapPipeline()
    assert pipeline.step(frame, None, 0.0).status == "exploring"
    assert pipeline.step(frame, uncertainty, 1.0).status == "invalid_input"


def test_flat_maps_and_frames_out_of_order() -> None:
    for level in (0.0, 2.0):
        flat = np.full(SIZE, level, np.float32)
        assert tasks.find_regions(flat).status == "flat"
        assert tasks.DodgePipeline().step(flat, 0.0).status == "no_obstacle"
        assert tasks.NavigatePipeline().step(flat, 0.0).weight == 0
        assert tasks.segment_pile(np.zeros((*SIZE, 3), np.uint8), flat).status == "no_object"
    pipeline = tasks.DodgePipeline()
    pipeline.step(calm(), 1.0)
    assert pipeline.step(calm(), 1.0).status == pipeline.step(calm(), float("nan")).status == "out_of_order"


def test_wrong_types_and_names_are_refused_in_one_sentence() -> None:
    options = tasks.MapOptions()
    with pytest.raises(ValueError, match=r"did you mean 'otsu'\? Known: fixed, quantile, otsu, median_mad"):
        options.rule = "ostu"
    with pytest.raises(ValueError, match="float32"):
        tasks.find_regions(np.zeros(SIZE))
    with pytest.raises(ValueError, match="uint8"):
        tasks.segment_pile(np.zeros((*SIZE, 3)), calm())
    options.low_quantile = 0.999
    with pytest.raises(ValueError, match="low_quantile < high_quantile"):
        tasks.find_regions(calm(), options)
    dodge = tasks.DodgeOptions()
    dodge.map.smooth_px = -1
    with pytest.raises(ValueError, match="smooth_px"):
        tasks.DodgePipeline(dodge)


def test_geometry_agrees_with_itself() -> None:
    camera = tasks.Camera.from_horizontal_fov(64, 48, 1.2)
    inverse_depth = np.full((48, 64), 0.2, np.float32)
    omega = np.array([0.02, -0.03, 0.05])
    still = tasks.motion_field(camera, inverse_depth, (0, 0, 1), (0, 0, 0), 0.1)
    turning = tasks.motion_field(camera, inverse_depth, (0, 0, 1), omega, 0.1)
    assert np.abs(turning - still).max() > 0.1
    np.testing.assert_allclose(tasks.derotate_flow(camera, turning, omega, 0.1), still, atol=0.02)
    y, x = np.mgrid[4:48:8, 4:64:8]
    begin = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    # Flying forward, the focus is the principal point.
    flow = 30 * still[y.ravel(), x.ravel()]
    focus = tasks.focus_of_expansion(begin, begin + flow)
    assert focus.status == "ok"
    np.testing.assert_allclose(focus.point_px, (camera.cx, camera.cy), atol=0.1)
    assert tasks.focus_of_expansion(begin[:2], begin[:2]).status == "too_few_points"


# --- overlays --------------------------------------------------------------------------------------------------------


def has(picture: NDArray[np.uint8], color: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - color).max(axis=2) < 10).any())


def test_overlays_show_what_was_found() -> None:
    frame = np.full((*SIZE, 3), 90, np.uint8)
    pipeline = tasks.DodgePipeline()
    for index in range(3):
        uncertainty = with_disc((120 + 6 * index, 120), 12 + index)
        result = pipeline.step(uncertainty, index * FRAME)
    picture = task_overlays.dodge_overlay(frame, uncertainty, result, tasks.DodgePolicy().update((1, 0), 0.0))
    assert picture.dtype == np.uint8 and picture.shape[1] == 2 * 2 * SIZE[1]
    assert all(has(picture, color) for color in (task_overlays.RED, task_overlays.GREEN, task_overlays.YELLOW))

    walled = calm()
    walled[:, 130:160] = 2.0
    navigate = task_overlays.navigate_overlay(frame, walled, tasks.NavigatePipeline().step(walled, 0.0))
    assert has(navigate, task_overlays.CYAN) and has(navigate, task_overlays.RED)
    steps = task_overlays.steps_picture(result.steps, frame)
    assert steps.shape == (SIZE[0], 5 * SIZE[1], 3)
    with pytest.raises(ValueError, match="no intermediates"):
        task_overlays.steps_picture(tasks.find_regions(np.zeros((0, 0), np.float32)))


def test_overlays_of_nothing_are_pictures_too() -> None:
    frame, nothing = np.zeros((*SIZE, 3), np.uint8), np.full(SIZE, np.nan, np.float32)
    assert task_overlays.dodge_overlay(frame, nothing, tasks.DodgePipeline().step(nothing, 0.0)).any()
    assert task_overlays.navigate_overlay(frame, nothing, tasks.NavigatePipeline().step(nothing, 0.0)).any()
    assert task_overlays.segment_overlay(frame, nothing, tasks.segment_pile(frame, nothing)).any()
    assert task_overlays.gap_overlay(frame, None, tasks.GapPipeline().step(frame, None, 0.0)).any()


# --- alignment -------------------------------------------------------------------------------------------------------


def texture(seed: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).uniform(0, 255, (SIZE[0] // 8, SIZE[1] // 8, 3))
    fine = np.kron(coarse, np.ones((8, 8, 1)))
    return ((fine + np.roll(fine, 3, 0) + np.roll(fine, 3, 1) + np.roll(fine, (3, 3), (0, 1))) / 4).astype(np.uint8)


def test_a_shift_of_the_wall_is_taken_out() -> None:
    wall = texture(0)
    shifted = np.roll(wall, (4, -7), (0, 1))
    found = tasks.align_to(wall, shifted)
    assert found.found and found.inliers >= 0.8 * found.tracked
    np.testing.assert_allclose(found.reference_from_frame[:2, 2], (7, -4), atol=0.3)
    inside = np.s_[30:-30, 30:-30]
    assert np.abs(found.image[inside].astype(int) - wall[inside]).mean() < 4
    assert found.valid is not None and not found.valid[:, :4].any()
    field = np.stack([np.full(SIZE, 3.0), np.full(SIZE, 4.0)], axis=-1).astype(np.float32)
    field[:, :4] = 50
    np.testing.assert_allclose(found.within(field), 5.0)
    plain = tasks.align_to(np.full_like(wall, 90), wall)
    assert not plain.found and np.array_equal(plain.image, wall)
    with pytest.raises(ValueError, match="one size"):
        tasks.align_to(wall, wall[:, :100])


def test_a_turn_is_taken_out() -> None:
    frame = texture(1)
    angle = 0.05  # to the right: what was ahead is seen on the left
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    back = tasks.derotate_frame(frame, turn, 1.2)
    focal = SIZE[1] / 2 / np.tan(0.6)
    center = np.array([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2, 1.0])
    moved = back.reference_from_frame @ center
    np.testing.assert_allclose(moved[:2] / moved[2], (center[0] + focal * np.tan(angle), center[1]), atol=1e-6)
    np.testing.assert_array_equal(tasks.derotate_frame(frame, np.eye(3), 1.2).image, frame)
    with pytest.raises(ValueError, match="rotation"):
        tasks.derotate_frame(frame, 2 * np.eye(3), 1.2)
