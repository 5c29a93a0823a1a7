# SPDX-License-Identifier: MIT
"""The flight program flies the simulated vehicle over MAVLink: frames in by a folder, overridden sticks out."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("pymavlink", reason="pymavlink is not installed")

import ajna
from ajna.flight_program import find_program
from ajna.sim import make_method, make_world
from ajna.sim.camera import CameraModel
from ajna.sim.episode import run_episode
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.methods.program import LOITER_M_S, TRIM_US, FlightProgram

try:
    rendering_backend()
except NoRenderingError as error:
    pytest.skip(str(error), allow_module_level=True)

BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")
PROGRAM = Path(BUILD or ".") / "cpp" / "apps" / "ajna_flight"

needs_program = pytest.mark.skipif(
    not (BUILD and PROGRAM.is_file() and ajna.model.models()),
    reason="ajna_flight is not built (AJNA_TEST_BUILD_DIR names the build), or this build ships no model",
)
# Small pictures, and a clock so slow that a busy machine renders them in time.
CAMERA = CameraModel(width=160, height=128, subframes=1, render_scale=1)
SCALE = 0.1


@needs_program
def test_the_program_sets_out_through_a_forest(tmp_path: Path) -> None:
    world = dataclasses.replace(make_world("forest", 3, CAMERA), time_limit_s=0.6)
    program = FlightProgram(program=PROGRAM, time_scale=SCALE, log=tmp_path)
    try:
        result = run_episode(world, program, reference=False)
        assert result.reason == "time"
        assert result.path[-1][1] - result.path[0][1] > 0.05, program.said  # towards the goal
        assert abs(result.path[-1][3] - result.path[0][3]) < 0.2  # the autopilot holds the height
        assert result.detection_iou is None and result.run_time_ms is None  # it shows nobody its masks
        assert "active: commands are being sent" in program.said
    finally:
        program.close()
    (log,) = tmp_path.glob("*.jsonl")
    text = log.read_text()
    assert '"task": "navigate"' in text and '"type": "end"' in text, "it ended by itself on SIGTERM"
    assert '"status": "first_frame"' in text


@needs_program
def test_it_looks_for_a_gap() -> None:
    world = dataclasses.replace(make_world("gap", 1002, CAMERA), time_limit_s=0.9)
    program = FlightProgram(program=PROGRAM, time_scale=SCALE)
    try:
        result = run_episode(world, program, reference=False)
        sideways = np.ptp([point[2] for point in result.path])
        assert sideways > 0.02, program.said  # the exploratory diagonal
    finally:
        program.close()


def test_a_program_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="AJNA_FLIGHT_PROGRAM"):
        find_program(tmp_path / "ajna_flight")
    monkeypatch.setenv("AJNA_FLIGHT_PROGRAM", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match="none"):
        make_method("flight")


@pytest.mark.parametrize("text", ["0", "2", "fast", "nan"])
def test_a_time_scale_out_of_range_is_refused(
    text: str, tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ajna_flight"
    program.touch()
    monkeypatch.setenv("AJNA_FLIGHT_TIME_SCALE", text)
    with pytest.raises(ValueError, match=f"AJNA_FLIGHT_TIME_SCALE is '{text}'"):
        FlightProgram(tiny_checkpoint, program)


def test_a_program_that_ends_is_reported(tmp_path: Path) -> None:
    script = tmp_path / "broken"
    script.write_text("#!/bin/sh\necho this machine has no wings >&2\nexit 3\n")
    script.chmod(0o755)
    model = tmp_path / "model.pt"
    model.touch()
    program = FlightProgram(model, script, SCALE)
    try:
        with pytest.raises(RuntimeError, match="no wings"):
            run_episode(make_world("dodge", 0, CAMERA), program)
    finally:
        program.close()


def test_sticks_of_loiter(tmp_path: Path) -> None:
    script = tmp_path / "idle"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)
    program = FlightProgram(script, script, SCALE)
    world = make_world("forest", 0, CAMERA)
    try:
        from ajna.sim.observation import TaskSetup

        program.reset(TaskSetup("navigate", CAMERA, world.speed_m_s, 0.25, 0))
        assert program._sticks() is None  # released
        program._vehicle.channels[:4] = [int(TRIM_US)] * 4
        assert program._sticks() is None  # in the middle: LOITER holds the place
        program._vehicle.channels[:4] = [1750, 1250, 1600, 1400]
        command = program._sticks()
        assert command is not None
        assert command.velocity_m_s == pytest.approx((LOITER_M_S / 2, LOITER_M_S / 2, -LOITER_M_S / 5))
        assert command.yaw_rate_rad_s < 0
    finally:
        program.close()
