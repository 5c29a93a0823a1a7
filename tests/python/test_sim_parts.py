# SPDX-License-Identifier: MIT
"""The simulator without pictures: vehicle, pilots, statistics, sensor models, adapters, errors."""

from __future__ import annotations

import importlib
import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

import ajna
from ajna.sim import Command, make_method, make_world
from ajna.sim.benchmark import EXPERIMENTS, as_markdown, cost_of, rows_of
from ajna.sim.camera import CameraModel, add_sensor_noise, exposure_gain
from ajna.sim.episode import EpisodeResult, intersection_over_union
from ajna.sim.flight import Flight
from ajna.sim.methods import METHODS
from ajna.sim.methods.base import largest_region
from ajna.sim.methods.events import EventSensor
from ajna.sim.methods.flow import OcclusionMask
from ajna.sim.observation import TaskSetup
from ajna.sim.pilots import DodgePilot, NavigatePilot
from ajna.sim.statistics import bootstrap_interval, summarize
from ajna.sim.vehicle import GRAVITY, VehicleConfig
from ajna.sim.worlds import WORLDS
from ajna.sim.worlds.gap import SHAPES, TOLERANCE_M


@pytest.fixture(scope="module")
def hover_world():
    return make_world("dodge", 0)


def flight_in(world) -> Flight:
    """Physics only: the frames cannot be looked at."""
    return Flight(world, SimpleNamespace(camera=world.camera), seed=0)


def fly(flight: Flight, command: Command, seconds: float) -> np.ndarray:
    """(t, velocity, tilt) once a frame."""
    log = []
    for _ in range(round(seconds * 30)):
        flight.advance(command)
        log.append([flight.time_s, *flight.velocity, math.acos(min(1.0, flight.rotation[2, 2]))])
    return np.array(log)


def test_hover_stays(hover_world) -> None:
    flight = flight_in(hover_world)
    fly(flight, Command(), 0.5)
    assert np.abs(flight.position - hover_world.start).max() < 0.01
    assert np.abs(flight.velocity).max() < 0.02


@pytest.mark.parametrize(("axis", "world_axis", "sign"), [(0, 0, 1), (1, 1, -1), (2, 2, -1)])
def test_velocity_step(hover_world, axis: int, world_axis: int, sign: int) -> None:
    """Forward, right and down are x, -y and -z: 90 % within 0.9 s, no more than 15 % beyond, little elsewhere."""
    flight = flight_in(hover_world)
    speed = 0.9 if axis == 2 else 2.0  # down: the floor is near
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    log = fly(flight, Command(tuple(velocity)), 1.2)
    along = sign * log[:, 1 + world_axis]
    assert along[26] > 0.9 * speed
    assert along.max() < 1.15 * speed
    across = np.delete(log[:, 1:4], world_axis, axis=1)
    assert np.abs(across).max() < 0.25 * speed
    assert log[:, 4].max() < VehicleConfig().cruise_tilt_rad + 0.06


def test_yaw_rate_turns_right(hover_world) -> None:
    flight = flight_in(hover_world)
    fly(flight, Command(yaw_rate_rad_s=1.0), 1.0)
    heading = math.atan2(flight.rotation[1, 0], flight.rotation[0, 0])
    assert heading == pytest.approx(-1.0, abs=0.12)  # about z up; the first tenth of a second is spent turning up


def test_full_thrust_is_the_papers(hover_world) -> None:
    """4.9 : 1: from hover, after the motors' lag, straight up at 3.9 g (drag is small)."""
    flight = flight_in(hover_world)
    log = fly(flight, Command(None, 0.0, (0.0, 0.0, -20 * GRAVITY)), 0.3)
    climb = np.diff(log[3:, 3]) * 30
    assert climb.max() == pytest.approx(3.9 * GRAVITY, rel=0.06)


def test_thrust_vector_tilts_to_its_limit(hover_world) -> None:
    flight = flight_in(hover_world)
    log = fly(flight, Command(None, 0.0, (0.0, 40.0, -GRAVITY)), 0.4)
    limit = VehicleConfig().max_tilt_rad
    assert limit - 0.06 < log[-1, 4] < limit + 0.1
    assert log[-1, 2] < -2.0  # to the right is -y


def test_contact_is_a_collision(hover_world) -> None:
    flight = flight_in(hover_world)
    fly(flight, Command((0.0, 0.0, 3.0)), 1.2)
    assert flight.collision == "ground"


def test_equal_seeds_equal_worlds() -> None:
    first, second, other = (make_world("indoor-forest", seed) for seed in (0, 0, 8))
    assert np.array_equal(first.model.geom_pos, second.model.geom_pos)
    assert np.array_equal(first.model.tex_data, second.model.tex_data)
    assert first.model.geom_pos.shape != other.model.geom_pos.shape or not np.array_equal(
        first.model.geom_pos, other.model.geom_pos
    )


def test_forest_is_the_papers() -> None:
    world = make_world("forest", 0)
    centers = np.array([outline.points[:-1].mean(axis=0) for outline in world.outlines])
    diameters = np.array([np.ptp(outline.points[:, 0]) for outline in world.outlines])
    gaps = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1)) + 99 * np.eye(len(centers))
    assert gaps.min() >= 3.0
    assert diameters.min() >= 0.6 - 1e-9 and diameters.max() <= 0.9 + 1e-9
    inside = (centers[:, 0] <= 40) & (np.abs(centers[:, 1]) <= 10)
    assert 35 <= inside.sum() <= 60


@pytest.mark.parametrize("shape", list(SHAPES))
def test_gap_leaves_the_tolerance(shape: str) -> None:
    """The vehicle's front, grown by 8 cm, lies inside the contour and touches it."""
    from ajna.sim.worlds.gap import _fitted

    vehicle = VehicleConfig()
    contour = _fitted(SHAPES[shape](np.random.default_rng(5)), vehicle)
    half = np.array([vehicle.half_width_m + TOLERANCE_M, vehicle.half_height_m + TOLERANCE_M])
    t = np.linspace(-1, 1, 201)
    border = np.concatenate([np.c_[t, np.full(201, s)] for s in (-1, 1)] + [np.c_[np.full(201, s), t] for s in (-1, 1)])
    border = border * half
    room = contour(np.arctan2(border[:, 1], border[:, 0])) - np.hypot(*border.T)
    assert -1e-3 < room.min() < 5e-3


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(ValueError, match="did you mean 'forest'"):
        make_world("forrest", 0)
    with pytest.raises(ValueError, match="did you mean 'occmask'"):
        make_method("ocmask")
    with pytest.raises(ValueError, match="--weights"):
        make_method("midas")
    with pytest.raises(ValueError, match="takes no weights"):
        make_method("depth", "some.pt")
    with pytest.raises(ValueError, match="negative"):
        make_world("forest", -1)


def test_method_refuses_other_tasks() -> None:
    setup = TaskSetup("pile", CameraModel(), 0.0, 0.25, 0)
    with pytest.raises(ValueError, match="'gapflyt' does not pile; it does: gap"):
        make_method("gapflyt").reset(setup)


def test_pilot_goes_around_a_wall() -> None:
    """A wall ahead and to the left; free to the right: the safe point lies right of the middle, and so the command."""
    camera = CameraModel()
    pilot = NavigatePilot(TaskSetup("navigate", camera, 4.0, 0.25, 0))
    depth = np.full((camera.height, camera.width), np.inf)
    depth[:, : camera.width // 2 + 20] = 3.0
    level = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)  # camera axes to forward, right, down
    observation = SimpleNamespace(
        frame=SimpleNamespace(camera=camera), heading_from_camera=level, displacement_m=np.zeros(3), yaw_rad=0.0,
        height_m=1.5, hold_height_m=1.5, goal_m=np.array([20.0, 0, 0]), velocity_m_s=np.array([2.0, 0.0, 0.0]),
        pixel=lambda d: (camera.focal_px * d[1] / d[0] + camera.center_px[0], 0.0),
    )  # fmt: skip
    output = pilot(depth, observation)
    edge = camera.width / 2 + 20
    assert output.point_px[0] > edge + 0.37 / 3 * camera.focal_px - 5  # half a vehicle beyond the edge
    assert output.command.velocity_m_s[1] > 0.5
    assert output.command.yaw_rate_rad_s > 0
    ahead = NavigatePilot(TaskSetup("navigate", camera, 4.0, 0.25, 0))(np.full_like(depth, np.inf), observation)
    assert ahead.command.velocity_m_s == pytest.approx((4.0, 0.0, 0.0), abs=0.1)


@pytest.mark.parametrize(("columns", "side"), [((200, 205, 210), -1), ((120, 115, 110), 1)])
def test_dodge_waits_for_three_frames_and_goes_away(columns: tuple[int, ...], side: int) -> None:
    camera = CameraModel()
    pilot = DodgePilot(TaskSetup("dodge", camera, 0.0, 0.25, 0))
    for i, column in enumerate(columns):
        mask = np.zeros((camera.height, camera.width), bool)
        mask[100:110, column - 5 : column + 5] = True
        frame = SimpleNamespace(camera=camera, time_s=i / 30)
        observation = SimpleNamespace(
            frame=frame, displacement_m=np.zeros(3), yaw_rad=0.0, height_m=1.5, hold_height_m=1.5
        )
        output = pilot(mask, observation)
        assert output.decided == (i == 2)
    assert np.sign(output.command.thrust_m_s2[1]) == side


def test_bootstrap_interval() -> None:
    random = np.random.default_rng(1)
    sample = random.random(400) < 0.8
    low, high = bootstrap_interval(sample)
    half = 1.96 * math.sqrt(sample.mean() * (1 - sample.mean()) / 400)
    assert low == pytest.approx(sample.mean() - half, abs=0.008)
    assert high == pytest.approx(sample.mean() + half, abs=0.008)
    assert bootstrap_interval([1.0, 1.0]) == (1.0, 1.0)
    with pytest.raises(ValueError, match="at least one"):
        bootstrap_interval([])
    with pytest.raises(ValueError, match="level"):
        bootstrap_interval([1.0], level=1.5)


def result_with(**changes) -> EpisodeResult:
    values = dict(  # noqa: C408
        world="forest", method="x", seed=0, success=True, reason="goal", touched=None, variant=None, duration_s=2.0,
        frames=60, path_length_m=11.0, mean_speed_m_s=5.5, reference_path_length_m=10.0, run_time_ms=3.0,
    )  # fmt: skip
    return EpisodeResult(**{**values, **changes})


def test_summary() -> None:
    results = [
        result_with(detection_iou=0.6, safe_point_error_px=2.0),
        result_with(success=False, reason="collision", path_length_m=3.0, detection_iou=0.4, safe_point_error_px=4.0),
        result_with(reference_path_length_m=None, run_time_ms=9.0),
    ]
    record = summarize(results)
    assert record["success_rate"] == pytest.approx(2 / 3)
    assert record["path_increase_percent"] == pytest.approx(10.0)  # only where both arrived
    assert record["safe_point_error_px"] == pytest.approx(3.0)
    assert record["detection_rate"] == pytest.approx(0.5)
    assert record["run_time_ms"] == pytest.approx(3.0)
    assert record["outcomes"] == {"collision": 1, "goal": 2}
    assert record["success_rate_ci"][0] < record["success_rate"] < record["success_rate_ci"][1]
    json.dumps(record)
    with pytest.raises(ValueError, match="no trials"):
        summarize([])


def test_tables_name_known_methods() -> None:
    assert set(EXPERIMENTS) == set(WORLDS)
    for experiment in EXPERIMENTS:
        rows = rows_of(experiment)
        assert {row.method for row in rows} <= set(METHODS)
        table = as_markdown(experiment, rows)
        assert table.count("\n") == len(rows) + 1
        for row, line in zip(rows, table.split("\n")[2:], strict=True):
            wants = any(name in row.paper.title for name in ("MiDaS", "Net", "R-CNN", "PointRend"))
            assert ("weights not given" if wants else "not run") in line
    assert [row.method for row in rows_of("gap", ["gapflyt"])] == ["gapflyt"]
    with pytest.raises(ValueError, match="not a method of 'pile'"):
        rows_of("pile", ["gapflyt"])


def test_tables_count_our_network() -> None:
    (row,) = rows_of("forest", ["ajna"])
    assert cost_of("depth") is None and cost_of("ajna-true-flow") is None
    row.cost = cost_of("ajna")
    assert row.cost is not None and row.cost.parameters == ajna.load().info.parameters
    last = as_markdown("forest", [row]).split("\n")[-1]
    assert last.endswith(f"| 6.3 | {row.cost.flops / 1e9:.1f} | 2.70 | {row.cost.parameters / 1e6:.2f} |")
    assert row.to_json()["cost"]["flops"] == row.cost.flops


def test_intersection_over_union() -> None:
    a, b = np.zeros((2, 4), bool), np.zeros((2, 4), bool)
    assert intersection_over_union(a, b) == 0.0
    a[:, :3], b[:, 1:] = True, True
    assert intersection_over_union(a, b) == pytest.approx(4 / 8)


def test_sensor_noise_is_shot_and_read_noise() -> None:
    camera = CameraModel()
    random = np.random.default_rng(0)
    for level in (20.0, 180.0):
        picture = add_sensor_noise(np.full((200, 200, 3), level), camera, 1.0, random).astype(float)
        expected = math.sqrt(camera.read_noise**2 + camera.shot_noise**2 * level + 1 / 12)
        assert picture.mean() == pytest.approx(level, abs=0.05)
        assert picture.std() == pytest.approx(expected, rel=0.03)
    gains = [exposure_gain(camera, 7, t / 30) for t in range(600)]
    assert 0.01 < np.std(gains) < 0.08
    assert np.abs(np.diff(gains)).max() < 0.02  # slow
    assert gains[5] == exposure_gain(camera, 7, 5 / 30)


def test_events_count_steps_of_the_logarithm() -> None:
    sensor = EventSensor(threshold=0.2)
    grey = np.full((4, 5, 3), 60, np.uint8)
    assert not sensor(grey).any()
    brighter = grey.copy()
    brighter[1, 2] = round(70 * math.exp(0.45) - 10)  # 2.25 thresholds up
    darker = brighter.copy()
    darker[3, 3] = round(70 * math.exp(-0.25) - 10)
    assert sensor(brighter)[1, 2] == 2
    events = sensor(darker)
    assert events[3, 3] == -1 and np.count_nonzero(events) == 1  # the rest of the first step is kept


def test_what_leaves_the_picture_is_not_occluded() -> None:
    """A picture that slides by 8 pixels occludes nothing; a square that slides over a still one does."""
    import cv2

    random = np.random.default_rng(0)
    wide = cv2.GaussianBlur(random.integers(0, 255, (120, 200, 3), dtype=np.uint8), (0, 0), 1.5)
    sliding = OcclusionMask()
    sliding.reset(TaskSetup("pile", CameraModel(), 0.0, 0.25, 0))
    assert sliding.mask(SimpleNamespace(rgb=np.ascontiguousarray(wide[:, :160])), False) is None  # the first one
    assert not sliding._occluded(SimpleNamespace(rgb=np.ascontiguousarray(wide[:, 8:168]))).any()

    still = np.ascontiguousarray(wide[:, :160])
    first, second = still.copy(), still.copy()
    first[40:80, 50:90] = wide[:40, 160:]
    second[40:80, 58:98] = wide[:40, 160:]
    moving = OcclusionMask()
    moving.reset(TaskSetup("dodge", CameraModel(), 0.0, 0.25, 0))
    moving.mask(SimpleNamespace(rgb=first), False)
    occluded = moving._occluded(SimpleNamespace(rgb=second))
    assert occluded[42:78, 50:58].mean() > 0.5  # uncovered
    occluded[34:86, 44:104] = False
    assert occluded.mean() < 0.01


def test_largest_region() -> None:
    mask = np.zeros((10, 10), bool)
    mask[1:3, 1:3], mask[5:9, 5:9] = True, True
    assert largest_region(mask).sum() == 16
    assert largest_region(mask, least_px=17) is None
    assert largest_region(np.zeros((4, 4), bool)) is None


def test_without_mujoco_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "mujoco" or name.startswith("ajna.sim")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r'install it with: pip install "ajna\[sim\]"') as caught:
        importlib.import_module("ajna.sim")
    assert isinstance(caught.value, RuntimeError)  # what the command line expects
    assert "\n" not in str(caught.value)


def test_no_rendering_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    from ajna.sim import gl

    monkeypatch.setattr(gl, "_chosen", None)
    monkeypatch.setattr(gl, "_PROBLEMS", {"egl": lambda: "no libEGL", "osmesa": lambda: "no libOSMesa"})
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(gl.NoRenderingError, match="libegl1.*libosmesa6"):
        gl.rendering_backend()
    monkeypatch.setattr(gl, "_PROBLEMS", {"egl": lambda: "no libEGL", "osmesa": lambda: None})
    assert gl.rendering_backend() == "osmesa"
