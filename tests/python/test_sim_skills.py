# SPDX-License-Identifier: MIT
"""Ajna in the loop of the simulation: true occlusion as a signal, timing, and a short trial of each skill."""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

import ajna
from ajna import tasks
from ajna.sim import Frame, make_method, make_world, occlusion_and_flow
from ajna.sim.benchmark import EXPERIMENTS, task_of
from ajna.sim.camera import CameraModel
from ajna.sim.episode import run_episode, true_mask
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.methods import METHODS
from ajna.sim.methods.signals import Source, TrueMotionSignal, occlusion_jump
from ajna.sim.methods.skills import OUR_VEHICLE, PAPERS_VEHICLE, FlightTiming, Pace, SkillMethod, Timing
from ajna.sim.observation import Observation, TaskSetup
from ajna.sim.render import Renderer
from ajna.sim.trials import TrialPlan, _settings

try:
    rendering_backend()
except NoRenderingError as error:
    pytest.skip(str(error), allow_module_level=True)

needs_model = pytest.mark.skipif(not ajna.model.models(), reason="this build ships no model")


def test_occlusion_jump_marks_what_moves_on_both_sides() -> None:
    camera = CameraModel(width=160, height=120)
    world = make_world("dodge", 0, camera)
    with Renderer(world.model, camera) as renderer:
        before, later = world.initial_qpos(), world.initial_qpos()
        before[7:10], later[7:10] = [2.0, 0.3, 1.6], [2.0, 0.0, 1.6]
        first, second = (Frame(renderer, [state], i, 0.0, 0) for i, state in enumerate((before, later)))
        jump = occlusion_jump(first, second)
        still = occlusion_jump(first, Frame(renderer, [before], 1, 0.0, 0))
        thrown = true_mask(world, first)
        _, flow = occlusion_and_flow(first, second)
    assert not still.any()
    speed = np.median(np.linalg.norm(flow[thrown], axis=1))
    assert speed > 8
    assert np.median(jump[jump > 0]) == pytest.approx(speed, rel=0.1)  # the background stands still
    assert (jump[thrown] > 0).any() and (jump[~thrown] > 0).any()
    rows, columns = np.nonzero(jump)
    assert np.ptp(columns) < np.ptp(np.nonzero(thrown)[1]) + 2.2 * speed and np.ptp(rows) < 20


@pytest.mark.parametrize("velocity", [(3.0, 0.4, -0.1), (0.0, 0.0, 0.0)])
def test_true_motion_is_what_navigating_takes_a_map_for(velocity: tuple[float, float, float]) -> None:
    """From the map along the horizon navigating finds the true distances again."""
    camera = CameraModel(width=160, height=120)
    world = make_world("forest", 1, camera)
    now = world.initial_qpos()
    before = now.copy()
    before[:3] -= 0.1 * np.array([velocity[0], -velocity[1], -velocity[2]])  # forward, left, up
    signal = TrueMotionSignal()
    options = tasks.SkillOptions()
    signal.adapt(options)
    with Renderer(world.model, camera) as renderer:
        frames = [Frame(renderer, [qpos], i, 0.1 * i, 0) for i, qpos in enumerate((before, now))]
        depth = frames[1].depth
        level = np.diag([1.0, -1.0, -1.0]) @ frames[1].T_world_camera[:3, :3]
        second, first = (SimpleNamespace(tag=SimpleNamespace(frame=f, heading_from_camera=level)) for f in frames)
        map_ = signal.source(camera)(first, second, "rotation")
    assert map_.dtype == np.float32 and map_.shape == depth.shape
    if not any(velocity):
        assert np.all(map_ == np.float32(options.horizon.floor))
        return
    options.horizon.band, options.horizon.column_step, options.horizon.max_distance_m = 0.02, 1, 50.0
    options.horizon.range_moves = 1e6
    found = tasks.horizon_obstacles(map_, level, camera.horizontal_fov_rad, 0.1 * np.array(velocity), options.horizon)
    row = depth[round(camera.center_px[1])]
    near = np.array([thing[0] for thing in found])
    assert len(near) > 40
    columns = np.array([camera.center_px[0] + camera.focal_px * right / ahead for ahead, right in found])
    true = row[np.rint(columns).astype(int)]
    assert np.median(np.abs(near / true - 1)) < 0.02


def test_timing_in_frames() -> None:
    assert Timing().in_frames(30.0) == (1, 0)
    assert PAPERS_VEHICLE.in_frames(30.0) == (4, 2)  # 7.5 Hz; 49 ms are over before the second frame
    with pytest.raises(ValueError, match="rate"):
        Timing(rate_hz=0.0).in_frames(30.0)
    with pytest.raises(ValueError, match="latency"):
        Timing(latency_s=-0.1).in_frames(30.0)
    with pytest.raises(ValueError, match="pair"):
        FlightTiming(pair_s=0.0).schedule(30.0)


def scheduled(timing: Pace, frames: int) -> list[int | None]:
    return list(itertools.islice(timing.schedule(30.0), frames))


def test_timing_frame_by_frame() -> None:
    assert scheduled(Timing(), 3) == [0, 0, 0]
    assert scheduled(PAPERS_VEHICLE, 8) == [None, None, None, 2, None, None, None, 2]
    assert scheduled(FlightTiming(pair_s=0.03), 3) == [1, 1, 1]
    # Frames are 33.3 ms apart: done after 43 ms, the second frame is the newest until 66.7; then after 86, 129, 172.
    # By then the sixth has come: the fifth is not looked at.
    assert scheduled(FlightTiming(pair_s=0.043), 6) == [2, 2, 2, 3, None, 2]
    # Just as long as two frames: each other one, with nothing left of the last.
    assert scheduled(FlightTiming(pair_s=2 / 30), 6) == [2, None, 2, None, 2, None]
    assert scheduled(FlightTiming(pair_s=0.21), 14) == [7, *[None] * 5, 7, *[None] * 5, 7, None]


@pytest.mark.parametrize("timing", [Timing(), PAPERS_VEHICLE, OUR_VEHICLE, FlightTiming(pair_s=0.1)])
def test_what_a_skill_is_told_of_its_timing_is_so(timing: Pace) -> None:
    rate_hz, latency_s = timing.averages(30.0)
    delays = [delay for delay in scheduled(timing, 3000) if delay is not None]
    assert len(delays) / 100 == pytest.approx(rate_hz, rel=0.01)
    assert np.mean(delays) / 30 == pytest.approx(latency_s, rel=0.01)
    if isinstance(timing, FlightTiming):
        assert rate_hz == pytest.approx(1 / timing.pair_s, rel=0.01)  # slower than the camera: never idle
        # It waits for less than a frame, and commands change at frames only, less than another one later.
        assert timing.pair_s - 1e-9 <= latency_s < timing.pair_s + 2 / 30


def observed(time_s: float) -> Observation:
    camera = CameraModel()
    frame = SimpleNamespace(camera=camera, time_s=time_s, rgb=np.zeros((240, 320, 3), np.uint8))
    level = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    return Observation(frame, level, np.zeros(3), np.zeros(3), 0.0, 1.5, np.array([20.0, 0, 0]), 1.5)


class Disc:
    """A thing on the right that grows and moves on to the right; counts how often it is asked for."""

    needs: frozenset[str] = frozenset()

    def __init__(self) -> None:
        self.calls = 0

    def source(self, camera: CameraModel) -> Source:
        return self._seen

    def adapt(self, options: tasks.SkillOptions) -> None: ...

    def _seen(self, first: tasks.Snapshot, second: tasks.Snapshot, common: str) -> np.ndarray:
        self.calls += 1
        y, x = np.mgrid[:240, :320]
        disc = np.hypot(x - 200 - 150 * first.time_s, y - 120) <= 8 + 90 * first.time_s
        return np.where(disc, np.float32(1.6), np.float32(0.2)).astype(np.float32)


@pytest.mark.parametrize(
    ("timing", "calls", "decided", "moved"), [(Timing(), 11, 3, 3), (PAPERS_VEHICLE, 3, 7, 9), (OUR_VEHICLE, 9, 3, 6)]
)
def test_dodge_plans_and_acts_when_its_timing_says(timing: Pace, calls: int, decided: int, moved: int) -> None:
    """Three detections make a decision; at 8 Hz two, four frames apart, and the command comes two frames later."""
    signal = Disc()
    method = SkillMethod("test", signal, timing)
    method.reset(TaskSetup("dodge", CameraModel(), 0.0, 0.25, 0))
    outputs = [method(observed(i / 30)) for i in range(12)]
    assert signal.calls == calls
    assert [output.planned for output in outputs].count(True) == calls + (timing is not PAPERS_VEHICLE)
    assert [i for i, output in enumerate(outputs) if output.decided] == [decided]
    outputs += [method(observed(i / 30)) for i in range(12, 15)]
    bursts = [i for i, output in enumerate(outputs) if output.command.velocity_m_s is None]
    assert bursts[0] == moved
    assert outputs[moved].command.thrust_m_s2[1] < -10  # to the left: it is seen on the right


def test_hold_keeps_the_place() -> None:
    method = SkillMethod("test", Disc(), Timing())
    method.reset(TaskSetup("gap", CameraModel(), 1.5, 0.25, 0))
    method(observed(0.0))
    pushed = observed(1 / 30)
    pushed.displacement_m = np.array([0.2, 0.1, 0.0])  # ahead and to the left, while the skill still waits
    pushed.velocity_m_s = np.array([1.0, 0.0, 0.0])
    assert method(pushed).command.velocity_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_methods_and_tables() -> None:
    paces = ("", "-8hz", "-flight-pace")
    for name in [signal + pace for signal in ("ajna", "ajna-true-flow") for pace in paces]:
        assert METHODS[name].timing is not None
        assert METHODS[name].takes_checkpoint == (not name.startswith("ajna-true"))
    exact, quick = make_method("ajna-flight-pace"), make_method("ajna-flight-pace-bfloat16")
    assert exact._signal._model.info.precision == "float32" and quick._signal._model.info.precision == "bfloat16"
    motion = {f"ajna-true-motion{pace}" for pace in paces}
    assert all(METHODS[name].tasks == {"navigate"} for name in motion)
    for experiment, rows in EXPERIMENTS.items():
        shown = motion & {row.method for row in rows}
        assert shown == (motion if task_of(experiment) == "navigate" else set())
        assert {"ajna", "ajna-true-flow"} <= {row.method for row in rows}, experiment
    with pytest.raises(ValueError, match="takes no weights"):
        make_method("ajna-true-flow", "some.safetensors")


@needs_model
def test_results_belong_to_a_model(tmp_path) -> None:
    plan = TrialPlan("dodge", "ajna", 1, 0, tmp_path)
    (shipped,) = (path for name, path in ajna.model.models().items() if name == "best")
    assert _settings(plan)["weights"] == [shipped.name]
    assert _settings(TrialPlan("dodge", "depth", 1, 0, tmp_path))["weights"] is None


def test_true_flow_dodges() -> None:
    result = run_episode(make_world("dodge", 2), "ajna-true-flow")
    assert result.success and result.reason == "missed"
    assert 0.6 < result.decided_s < 0.6 + 0.8
    assert result.best_iou >= 0.5


@needs_model
def test_network_finds_the_gap() -> None:
    world = dataclasses.replace(make_world("gap", 1002), time_limit_s=0.9)
    result = run_episode(world, "ajna")
    assert result.decided_s is not None and result.detection_iou >= 0.5


@needs_model
def test_network_sets_out_through_the_forest_at_8_hz() -> None:
    world = dataclasses.replace(make_world("forest", 1), time_limit_s=1.1)
    seen = []
    result = run_episode(world, "ajna-8hz", watch=lambda _, output: seen.append(output), reference=False)
    assert result.reason == "time" and result.path[-1][1] - result.path[0][1] > 0.5
    planned = [output for output in seen if output.planned]
    assert len(planned) == len(seen) // 4
    assert any(output.mask is not None for output in planned)
    assert any(output.point_px is not None for output in planned)
    assert math.isfinite(result.safe_point_error_px)
    assert math.isfinite(result.safe_point_error_same_px)


def test_true_motion_is_where_its_own_judge_is() -> None:
    world = dataclasses.replace(make_world("forest", 1), time_limit_s=1.5)
    result = run_episode(world, "ajna-true-motion", reference=False)
    assert result.safe_point_error_same_px == 0.0, "the same planner on the same maps"
    assert result.safe_point_error_px > 0.0, "the pilot of true depth chooses otherwise"
    other = run_episode(world, "d435i", reference=False)
    assert other.safe_point_error_same_px is None, "no skill"


def test_true_flow_looks_at_a_pile() -> None:
    result = run_episode(make_world("pile", 1), "ajna-true-flow")
    assert result.detection_iou > 0.3
