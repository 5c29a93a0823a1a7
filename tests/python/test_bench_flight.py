# SPDX-License-Identifier: MIT
"""`ajna bench flight`: the flight program flies, its own figures and those from outside come into one table."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="needs pymavlink")
pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna.benchmarks.flight import measure
from ajna.cli import main

BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")
PROGRAM = Path(BUILD or ".") / "cpp" / "apps" / "ajna_flight"
built = pytest.mark.skipif(
    not (BUILD and PROGRAM.is_file()), reason="ajna_flight is not built (AJNA_TEST_BUILD_DIR names the build)"
)


@built
def test_flies_with_each_file_and_writes_both_tables(
    flight_script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = measure(PROGRAM, {"tiny": flight_script}, size=(64, 48), threads=(1, 2), seconds=4.0)
    assert [row.threads for row in result.rows] == [1, 2]
    for row in result.rows:
        assert row.label == "tiny" and row.file == flight_script.name
        assert 100 < row.frames_sent <= 30 * 64  # 4 s at 30 Hz, and what came before the program was ready
        assert 0 < row.frames <= row.frames_sent
        assert 0 < row.looked_at <= row.frames
        assert row.activations >= 1 and row.commands_sent > 0 and 0 < row.commanding <= 1
        assert 0 < row.p50_ms <= row.p95_ms <= row.p99_ms
        assert row.damaged == row.network_failures == 0
        assert 0 < row.memory.settled <= row.memory.largest and row.memory.end <= row.memory.largest
        assert row.cpu_cores > 0
    text = result.to_markdown()
    assert text.count("| tiny |") == 2 and "64x48 at 30 Hz" in text
    assert json.loads(json.dumps(result.to_json()))["rows"][0]["memory"]["settled"] > 0


def command(out: Path, model: Path, *options: str) -> int:
    given = ["--program", PROGRAM, "--model", model, "--size", "64x48", "--threads", "1", "--out", out]
    return main(["bench", "flight", *map(str, given), *options])


@built
def test_command_exports_flies_and_writes_its_files(
    flight_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert command(out, flight_checkpoint, "--format", "torchscript", "--seconds", "2", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "flight.json").read_text())
    assert [row["label"] for row in printed["rows"]] == ["TorchScript float32"]
    assert "| TorchScript float32 | 1 |" in (out / "flight.md").read_text()


@built
def test_says_why_the_program_did_not_start(
    tiny_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Untrained weights: the program's self-test refuses them."""
    assert command(tmp_path / "out", tiny_checkpoint, "--format", "checkpoint", "--seconds", "1") != 0
    assert "self-test" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--format", "onnx"], "does not fly with 'onnx'"),
        (["--task", "pile"], "unknown task 'pile'"),
        (["--rate", "0"], "0 Hz"),
        (["--seconds", "-1"], "-1 s"),
        (["--model", "nowhere.pt"], "nowhere.pt"),
        (["--program", "nowhere/ajna_flight"], "nowhere/ajna_flight"),
    ],
)
def test_refusals_are_one_sentence(
    options: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / "ajna_flight"
    program.touch()
    given = ["--program", str(program), *options, "--format", "checkpoint"] if "--format" not in options else options
    assert main(["bench", "flight", *given]) == 2
    said = capsys.readouterr().err.strip()
    assert named in said and "Traceback" not in said and len(said.splitlines()) == 1
