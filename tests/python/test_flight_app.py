# SPDX-License-Identifier: MIT
"""The onboard program: one JSON line per frame pair, one sentence for bad input, never a crash."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import ajna

BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")
PROGRAM = Path(BUILD or ".") / "cpp" / "apps" / "ajna_flight"

pytestmark = pytest.mark.skipif(
    not (BUILD and PROGRAM.is_file()), reason="ajna_flight is not built (AJNA_TEST_BUILD_DIR names the build)"
)

KEYS = ["index", "frame1", "frame2", "latency_ms", "mean_flow_px", "mean_uncertainty", "mean_expected_error_px"]


def fly(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(PROGRAM), *map(str, arguments)], capture_output=True, text=True, check=False, timeout=120
    )


def refused(*arguments: object) -> str:
    """Runs, expects exit code 2 and nothing on stdout, and returns the last line of stderr."""
    result = fly(*arguments)
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    return result.stderr.strip().splitlines()[-1]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames of 64x48 that move by (2, 1) px; named so that text order is not their order."""
    from ajna import io

    folder = tmp_path_factory.mktemp("frames")
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for index in range(5):
        io.write_image(folder / f"frame{index + 8}.png", np.roll(image, (index, 2 * index), axis=(0, 1)))
    (folder / "notes.txt").write_text("no image")
    return folder


def copy_of(frames: Path, folder: Path) -> Path:
    for path in frames.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_a_line_per_pair_with_the_engines_numbers(tiny_checkpoint: Path, frames: Path) -> None:
    from ajna import io

    result = fly("--model", tiny_checkpoint, "--frames", frames, "--dry-run", "--threads", 1)
    assert result.returncode == 0, result.stderr
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert [record["index"] for record in records] == [0, 1, 2, 3]
    assert [record["frame1"] for record in records] == ["frame8.png", "frame9.png", "frame10.png", "frame11.png"]
    model = ajna.load(tiny_checkpoint)
    for record in records:
        assert list(record) == KEYS
        assert record["latency_ms"] > 0
        field = model(*(io.read_image(frames / record[key]) for key in ("frame1", "frame2")))
        assert record["mean_flow_px"] == pytest.approx(field.magnitude.mean(), rel=1e-3)
        assert record["mean_uncertainty"] == pytest.approx(field.uncertainty_norm.mean(), rel=1e-3)
        assert record["mean_expected_error_px"] == pytest.approx(field.expected_error_norm.mean(), rel=1e-3)
    assert "4 pairs of 64x48, 0 frames skipped" in result.stderr
    assert "median" in result.stderr and "p95" in result.stderr and "nothing was sent" in result.stderr


def test_size_and_max_frames(tiny_checkpoint: Path, frames: Path) -> None:
    options = ("--size", "32x24", "--max-frames", 3)
    result = fly("--model", tiny_checkpoint, "--frames", frames, "--dry-run", *options)
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == 2
    assert "2 pairs of 32x24" in result.stderr


def test_takes_torchscript(tiny_checkpoint: Path, frames: Path, tmp_path: Path) -> None:
    from ajna import nn

    script = tmp_path / "tiny.pt"
    nn.export_torchscript(script, *nn.load_checkpoint(tiny_checkpoint))
    outputs = [fly("--model", path, "--frames", frames, "--dry-run").stdout for path in (tiny_checkpoint, script)]
    checkpoint, scripted = ([json.loads(line) for line in output.splitlines()] for output in outputs)
    assert len(checkpoint) == len(scripted) == 4
    for one, other in zip(checkpoint, scripted, strict=True):
        assert one["mean_flow_px"] == pytest.approx(other["mean_flow_px"], rel=1e-3)


def test_without_dry_run_it_refuses(tiny_checkpoint: Path, frames: Path) -> None:
    assert "sends nothing to an autopilot" in refused("--model", tiny_checkpoint, "--frames", frames)


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def of_text(path: Path) -> None:
    path.write_text("not an image")


def of_another_size(path: Path) -> None:
    from ajna import io

    small: NDArray[np.uint8] = np.zeros((10, 10, 3), np.uint8)
    io.write_image(path, small)


@pytest.mark.parametrize("damage", [truncated, of_text, of_another_size])
def test_a_bad_frame_in_the_middle_is_reported_and_skipped(
    tiny_checkpoint: Path, frames: Path, tmp_path: Path, damage: object
) -> None:
    folder = copy_of(frames, tmp_path)
    damage(folder / "frame10.png")  # type: ignore[operator]
    result = fly("--model", tiny_checkpoint, "--frames", folder, "--dry-run")
    assert result.returncode == 0, result.stderr
    pairs = [(record["frame1"], record["frame2"]) for record in map(json.loads, result.stdout.splitlines())]
    assert pairs == [("frame8.png", "frame9.png"), ("frame11.png", "frame12.png")]
    assert "frame 'frame10.png' skipped" in result.stderr
    assert "1 frames skipped" in result.stderr


def test_bad_input_gives_one_sentence(tiny_checkpoint: Path, frames: Path, tmp_path: Path) -> None:
    good = ("--model", tiny_checkpoint, "--frames", frames, "--dry-run")
    assert "does not exist" in refused("--model", tmp_path / "no.safetensors", *good[2:])
    (tmp_path / "text.safetensors").write_text("no model")
    assert "text.safetensors" in refused("--model", tmp_path / "text.safetensors", *good[2:])
    assert "no.onnx" in refused("--model", tmp_path / "no.onnx", *good[2:])
    assert "missing" in refused(*good[:3], tmp_path / "missing", "--dry-run")
    (tmp_path / "empty").mkdir()
    assert "empty" in refused(*good[:3], tmp_path / "empty", "--dry-run")
    assert "--size '12'" in refused(*good, "--size", "12")
    assert "--size '0x4'" in refused(*good, "--size", "0x4")
    assert "--size '4x4x4'" in refused(*good, "--size", "4x4x4")
    assert "--threads" in refused(*good, "--threads", 0)
    assert "--max-frames" in refused(*good, "--max-frames", 1)
    assert "device 'gpu'" in refused(*good, "--device", "gpu")
    assert "--model is required" in refused("--frames", frames, "--dry-run")
    assert "--colour" in refused(*good, "--colour")


def test_no_usable_pair_is_an_error(tiny_checkpoint: Path, tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / f"{name}.png").write_text("not an image")
    result = fly("--model", tiny_checkpoint, "--frames", tmp_path, "--dry-run")
    assert result.returncode == 2
    assert "no two frames in a row" in result.stderr.splitlines()[-1]


def test_help_and_version() -> None:
    result = fly("--help")
    assert result.returncode == 0 and "--dry-run" in result.stdout and "Example" in result.stdout
    assert fly("--version").stdout.strip() == ajna.__version__
