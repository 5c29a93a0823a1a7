# SPDX-License-Identifier: MIT
"""The simulator with pictures: true depth and flow, one trial per world, replay, resume, the command line."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from ajna.sim import CameraModel, EpisodeResult, Frame, World, make_method, make_world, occlusion_and_flow, warp
from ajna.sim.episode import run_episode, true_mask
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.render import Renderer
from ajna.sim.trials import TrialPlan, load_trial, run_trials, trial_path
from ajna.sim.worlds import WORLDS

try:
    rendering_backend()
except NoRenderingError as error:
    pytest.skip(str(error), allow_module_level=True)

SMALL = CameraModel(width=160, height=120)


@pytest.fixture(scope="module")
def scenes() -> Iterator[dict[str, tuple[World, Renderer]]]:
    """Each world of seed 0 with a camera of 160 x 120."""
    made = {}
    for name in WORLDS:
        world = make_world(name, 0, SMALL)
        made[name] = (world, Renderer(world.model, SMALL))
    yield made
    for _, renderer in made.values():
        renderer.close()


def two_states(world: World) -> tuple[np.ndarray, np.ndarray]:
    """The camera before and after a move of a few centimetres with a slight turn; the thrown object flies meanwhile."""
    first = world.initial_qpos()
    if world.task == "pile":
        second = first.copy()
        first[:7], second[:7] = world.setup.views
        return first, second
    first[0] += 3.5 if world.task == "navigate" else 0.0
    second = first.copy()
    second[:3] += [0.06, 0.03, 0.01]
    second[3:7] = [0.99995, 0.0, 0.004, 0.009]
    if world.task == "dodge":
        first[7:10], second[7:10] = [2.0, 0.2, 1.6], [1.9, 0.25, 1.62]
        second[10:14] = np.array([0.99, 0.0, 0.1, 0.1]) / np.linalg.norm([0.99, 0.0, 0.1, 0.1])
    return first, second


@pytest.mark.parametrize("name", list(WORLDS))
def test_warping_by_true_flow_gives_the_first_frame(scenes, name: str) -> None:
    world = scenes[name][0]
    with Renderer(world.model, CameraModel()) as renderer:  # of the full size, where textures are finely sampled
        first, second = (Frame(renderer, [state], i, 0.0, 1) for i, state in enumerate(two_states(world)))
        occlusion, flow = occlusion_and_flow(first, second)
        error = np.abs(warp(second.clean, flow) - first.clean).mean(axis=2)
    seen = ~occlusion
    assert seen.mean() > 0.6
    assert np.isfinite(flow[seen]).all()
    assert np.median(error[seen]) < 2.0
    # The check can fail: no flow leaves a larger error.
    still = np.abs(second.clean.astype(float) - first.clean).mean(axis=2)
    assert np.median(error[seen]) < 0.7 * np.median(still[seen])


def test_flow_of_a_static_scene_is_the_motion_field(scenes) -> None:
    """Eq. 14: u = (x Vz - Vx) f / Z + ..., for a step so small that it holds to the first order."""
    world, renderer = scenes["indoor-forest"]
    first = world.initial_qpos()
    second = first.copy()
    step, turn = np.array([0.004, 0.002, -0.001]), 1e-3 * np.array([0.6, -0.8, 0.5])  # of the body: forward, left, up
    second[:3] += step
    second[3:7] = [np.sqrt(1 - 0.25 * (turn**2).sum()), *(turn / 2)]
    a, b = (Frame(renderer, [state], i, 0.0, 0) for i, state in enumerate((first, second)))
    occlusion, flow = occlusion_and_flow(a, b)
    # Camera axes x right, y down, z forward from forward, left, up; the camera sits 0.1 m before the turning point.
    to_camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    v = to_camera @ (step + np.cross(turn, [0.1, 0, 0]))
    w = to_camera @ turn
    x, y, z = SMALL.rays[..., 0], SMALL.rays[..., 1], a.depth
    u = (-v[0] + x * v[2]) / z + x * y * w[0] - (1 + x**2) * w[1] + y * w[2]
    down = (-v[1] + y * v[2]) / z + (1 + y**2) * w[0] - x * y * w[1] - x * w[2]
    difference = np.abs(flow - SMALL.focal_px * np.stack([u, down], -1))[~occlusion]
    size = np.linalg.norm(flow, axis=2)[~occlusion].mean()
    assert size > 0.08
    assert difference.max() < 0.02 * size + 2e-3


def test_depth_is_the_distance_along_the_axis(scenes) -> None:
    """The room's end is flat and 7.2 m from the start; the floor's depth follows from the height of the camera."""
    world, renderer = scenes["dodge"]
    frame = Frame(renderer, [world.initial_qpos()], 0, 0.0, 0)
    rays, depth = SMALL.rays, frame.depth
    below = (depth * rays[..., 1])[-8:, 40:120]
    assert below == pytest.approx(1.5, abs=0.01)
    center = depth[55:65, 70:90]
    assert np.abs(center - (7.5 - 0.1)).max() < 0.06  # boards on the wall are 4 cm thick


def test_forest_has_a_sky_that_only_turns(scenes) -> None:
    world, renderer = scenes["forest"]
    first = world.initial_qpos()
    first[2] = 30.0  # above the trees
    moved = first.copy()
    moved[0] += 2.0
    a, b = (Frame(renderer, [state], i, 0.0, 0) for i, state in enumerate((first, moved)))
    sky = np.isinf(a.depth)
    assert sky[:40].mean() > 0.9 and (a.geom[sky] == -1).all()
    _, flow = occlusion_and_flow(a, b)
    assert np.abs(flow[sky]).max() < 1e-3
    assert np.median(np.abs(flow[~sky])) > 0.2


def test_occlusion_lies_beside_what_is_near(scenes) -> None:
    """A camera that moves left uncovers on one side of the gap and hides on the other: as wide as the parallax."""
    world, renderer = scenes["gap"]
    first = world.initial_qpos()
    second = first.copy()
    second[1] += 0.3  # left: things in the picture move right, near ones more
    frames = [Frame(renderer, [state], i, 0.0, 0) for i, state in enumerate((first, second))]
    occlusion, _ = occlusion_and_flow(*frames)
    hole = true_mask(world, frames[0])
    row = int(np.median(np.nonzero(hole)[0]))
    columns = np.nonzero(hole[row])[0]
    hidden = occlusion[row, columns]
    parallax = SMALL.focal_px * 0.3 * (1 / (3.0 - 0.1) - 1 / (7.2 - 0.1))
    assert hidden.sum() == pytest.approx(parallax, abs=2.5)
    assert hidden[: len(columns) // 3].any() and not hidden[-2:].any()


def test_moving_object_has_its_own_flow(scenes) -> None:
    world, renderer = scenes["dodge"]
    before, later = two_states(world)
    later[10:14] = before[10:14]  # without turning: the surface then moves as the outline does
    first, second = (Frame(renderer, [state], i, 0.0, 1) for i, state in enumerate((before, later)))
    thrown = true_mask(world, first)
    assert thrown.sum() > 20
    _, flow = occlusion_and_flow(first, second)
    after = true_mask(world, second)

    def middle(mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask)
        return np.array([columns.mean(), rows.mean()])

    assert flow[thrown].mean(axis=0) == pytest.approx(middle(after) - middle(thrown), abs=0.6)


def test_blur_and_noise(scenes) -> None:
    """Averaging over a motion smooths along it; noise is new in every frame, and the same when asked for again."""
    world, renderer = scenes["gap"]
    first, second = two_states(world)
    moving = Frame(renderer, [first, (first + second) / 2, second], 0, 0.0, 3)
    again = Frame(renderer, [first, (first + second) / 2, second], 0, 0.0, 3)
    still = Frame(renderer, [first] * 3, 0, 0.0, 3)
    next_one = Frame(renderer, [first] * 3, 1, 0.0, 3)
    assert np.array_equal(moving.rgb, again.rgb)
    assert not np.array_equal(still.rgb, next_one.rgb)

    def detail(image: np.ndarray) -> float:
        return float(np.abs(np.diff(image.astype(float), axis=1)).mean())

    assert detail(moving.rgb) < 0.9 * detail(still.rgb)
    difference = still.rgb.astype(float) - next_one.rgb
    assert 1.5 < difference.std() < 6.0


def test_right_camera_sees_the_disparity(scenes) -> None:
    world, renderer = scenes["gap"]
    method = make_method("morpheyes")
    setup = SimpleNamespace(task="gap", camera=SMALL, speed_m_s=1.0, half_width_m=0.25, seed=0)
    method.reset(setup)
    frame = Frame(renderer, [world.initial_qpos()] * 3, 0, 0.0, 0)
    depth = method._perception._sensor(SimpleNamespace(frame=frame))
    wall = ~true_mask(world, frame) & np.isfinite(depth)
    assert wall.mean() > 0.5
    assert np.median(np.abs(depth[wall] / frame.depth[wall] - 1)) < 0.05


@pytest.mark.parametrize(("speed_m_s", "baseline_m"), [(4.8, 0.2), (1.6, 0.1)])
def test_the_stereo_baseline_is_short_among_near_things(speed_m_s: float, baseline_m: float) -> None:
    method = make_method("morpheyes")
    method.reset(SimpleNamespace(task="navigate", camera=SMALL, speed_m_s=speed_m_s, half_width_m=0.25, seed=0))
    assert method.baseline_m == baseline_m


def comparable(result: EpisodeResult) -> dict:
    record = dataclasses.asdict(result)
    del record["run_time_ms"], record["cpu_s"]
    return record


@pytest.mark.parametrize("name", ["forest", "indoor-forest", "boxes"])
def test_true_depth_flies_on(scenes, name: str) -> None:
    """The first second and a half: under way towards the goal, nothing touched."""
    world, renderer = scenes[name]
    short = dataclasses.replace(world, time_limit_s=1.5)
    result = run_episode(short, "depth", renderer)
    assert result.reason == "time" and result.touched is None
    assert result.path[-1][1] - result.path[0][1] > 0.5
    assert abs(result.path[-1][3] - world.start[2]) < 0.15


def test_true_depth_flies_through_the_gap_and_replays(scenes) -> None:
    world, renderer = scenes["gap"]
    result = run_episode(world, "depth", renderer)
    assert result.reason == "goal" and result.success
    assert result.detection_iou > 0.9
    assert result.path[-1][1] > world.setup.wall_x + 1
    straight = run_episode(dataclasses.replace(world, time_limit_s=2.0), "blind", renderer)
    assert not straight.success


def test_true_depth_dodges_and_hovering_is_hit(scenes) -> None:
    world, renderer = scenes["dodge"]
    result = run_episode(world, "depth", renderer)
    assert result.reason == "missed" and result.success
    assert result.detection_iou > 0.8
    again = run_episode(make_world("dodge", 0, SMALL), "depth")
    assert comparable(again) == comparable(result)
    hover = run_episode(world, "blind", renderer)
    assert hover.reason == "collision" and hover.touched == "thrown"


@pytest.mark.parametrize(("method", "least"), [("depth", 0.8), ("d435i", 0.5)])
def test_pile_methods_answer(scenes, method: str, least: float) -> None:
    world, renderer = scenes["pile"]
    result = run_episode(world, method, renderer)
    assert result.detection_iou >= least
    assert result.run_time_ms > 0


def test_event_density_sees_the_throw(scenes) -> None:
    world, renderer = scenes["dodge"]
    result = run_episode(world, "events", renderer)
    assert result.reason == "missed"
    assert result.detection_iou > 0.5


def test_trials_resume(tmp_path: Path) -> None:
    plan = TrialPlan("pile", "depth", 2, 0, tmp_path)
    flown: list[tuple[int, bool]] = []
    first = run_trials(plan, done=lambda result, known: flown.append((result.seed, known)))
    assert flown == [(0, False), (1, False)]
    assert [result.seed for result in first] == [0, 1]
    assert comparable(load_trial(plan, 0)) == comparable(first[0])
    trial_path(plan, 1).write_text('{"settings": {"for')  # as if the disk had been full
    flown.clear()
    second = run_trials(plan, done=lambda result, known: flown.append((result.seed, known)))
    assert flown == [(0, True), (1, False)]
    assert [comparable(r) for r in second] == [comparable(r) for r in first]
    assert sorted(path.name for path in plan.folder.iterdir()) == ["trial_000000.json", "trial_000001.json"]


def test_command_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from ajna.cli import main

    out = str(tmp_path / "out")
    assert main(["sim", "pile", "--method", "depth", "--trials", "1", "--out", out, "--json", "--video"]) == 0
    record = json.loads(capfd.readouterr().out)
    assert record["trials"] == 1 and record["detection_rate"] == 1.0
    folder = tmp_path / "out" / "pile" / "depth"
    names = {path.name for path in folder.iterdir()}
    assert names == {"trial_000000.json", "trial_000000.mp4", "summary.json", "paths.png"}
    assert main(["bench", "pile", "--trials", "1", "--out", out, "--method", "depth", "--method", "midas"]) == 0
    table = capfd.readouterr().out
    assert "| MiDaS | weights not given |" in table and "| true depth | 1 |" in table
    saved = json.loads((tmp_path / "out" / "bench_pile.json").read_text())
    assert [row["note"] for row in saved["rows"]] == ["", "weights not given"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["sim", "forrest"], "did you mean 'forest'"),
        (["sim", "forest", "--method", "gapflyt"], "cannot be used in 'forest'"),
        (["sim", "forest", "--method", "midas"], "--weights FILE"),
        (["bench", "gapp"], "Did you mean 'gap'"),
        (["bench", "gap", "--weights", "midas"], "not METHOD=FILE"),
    ],
)
def test_command_line_errors(tmp_path: Path, capfd: pytest.CaptureFixture[str], arguments, sentence: str) -> None:
    from ajna.cli import main

    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    error = capfd.readouterr().err
    assert sentence in error and "Traceback" not in error
    assert not (tmp_path / "out").exists()
