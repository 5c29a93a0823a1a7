# SPDX-License-Identifier: MIT
"""Flight logs read back: what they say, what damaged lines do, and the files that `ajna replay` writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ajna import flight_log, io
from ajna.cli import app, main


def lines() -> list[dict[str, Any]]:
    """Two seconds of flight at 10 Hz: commands from 0.5 s to 1.2 s, then a release."""
    rows: list[dict[str, Any]] = [
        {"type": "start", "time_s": 0.0, "task": "dodge", "model": "tiny", "dry_run": False, "frame_every": 2}
    ]
    for i in range(21):
        time_s = i / 10
        state = "active" if 0.5 <= time_s < 1.2 else "releasing" if 1.2 <= time_s < 1.7 else "standby"
        rows.append(
            {
                "type": "frame",
                "time_s": time_s,
                "index": i,
                "status": "incoming",
                "command": "velocity",
                "velocity_m_s": [0.0, 1.5, -0.5],
                "latency_ms": 10.0 + i,
                "mean_uncertainty": 0.5,
                "mean_flow_px": 2.0,
            }
        )
        row = {
            "type": "state",
            "time_s": time_s,
            "state": state,
            "fault": "none" if state == "active" else "switch_off",
            "mode": "LOITER",
            "velocity_m_s": [0.0, 1.5, -0.5],
            "frame_age_s": 0.02,
            "command_age_s": None if i == 0 else 0.04,
            "rc_age_s": 0.03,
            "switch_us": 2000 if state == "active" else 1000,
        }
        if state == "active":
            row["pulses_us"] = [1620, 1500, 1560, 1500, *[0] * 14]
        rows.append(row)
        if time_s == 1.2:
            rows.append({"type": "event", "time_s": 1.2, "text": "released (switch_off): the pilot's switch is off"})
    rows.append({"type": "end", "frames": 21})
    return rows


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "flight-0001.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in lines()))
    return path


def test_the_record_and_its_summary(log: Path) -> None:
    record = flight_log.read_log(log)
    assert (len(record.frames), len(record.states), len(record.events)) == (21, 21, 1)
    summary = record.summary()
    assert summary["duration_s"] == pytest.approx(2.0)
    assert summary["active_s"] == pytest.approx(0.7)
    assert summary["releases"] == 1 and summary["ended"] and summary["skipped_lines"] == 0
    assert summary["latency_p50_ms"] == pytest.approx(20.0)
    assert np.isnan(record.column(record.states, "command_age_s")[0])
    pulses = record.vectors(record.states, "pulses_us", 18)
    assert np.isnan(pulses[0]).all() and pulses[6, 0] == 1620


def test_damaged_lines_are_skipped_and_counted(log: Path) -> None:
    whole = log.read_bytes()
    log.write_bytes(whole[:-300] + b'\n{"type": "frame"}\n[1]\nnonsense\n\xff\n')
    record = flight_log.read_log(log)
    assert record.skipped_lines == 5
    assert not record.summary()["ended"]


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        flight_log.read_log(tmp_path / "none.jsonl")
    with pytest.raises(ValueError, match="is a folder"):
        flight_log.read_log(tmp_path)
    (tmp_path / "a.jsonl").write_text("hello\n")
    with pytest.raises(ValueError, match="no log of ajna_flight"):
        flight_log.read_log(tmp_path / "a.jsonl")
    (tmp_path / "b.jsonl").write_text(json.dumps(lines()[0]) + "\n")
    with pytest.raises(ValueError, match="before the flight began"):
        flight_log.read_log(tmp_path / "b.jsonl")


def test_plots_without_kept_frames(log: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["replay", str(log), "--out", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["video_frames"] == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["overview.png"]
    assert io.read_image(tmp_path / "out" / "overview.png").shape == (1000, 1400, 3)


def test_video_of_kept_frames(log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "flight-0001"
    folder.mkdir()
    for i in range(0, 21, 2):
        io.write_image(folder / f"{i:06d}.jpg", np.full((48, 64, 3), 10 * i, np.uint8))
    result = CliRunner().invoke(app, ["replay", str(log), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "released (switch_off)" in result.stdout and "commands were sent for 0.7 s" in result.stdout
    video = io.VideoSource(str(tmp_path / "out" / "flight.mp4"))
    assert video.fps == pytest.approx(5.0, rel=0.01)
    assert (video.width, video.height) == (512, 384 + 40)
    assert sum(1 for _ in video) == 11


def test_a_missing_log_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "none.jsonl"), "--out", str(tmp_path / "out")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
