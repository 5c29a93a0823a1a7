# SPDX-License-Identifier: MIT
"""`ajna bench speed`: what the rows hold, and how they follow from what was measured."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import ajna
from ajna import exports, nn
from ajna.benchmarks import speed, speed_worker
from ajna.benchmarks.machine import cpu_model
from ajna.cli import main
from ajna.cli.export import ExportFormat

Bench = Callable[..., str]


@pytest.fixture
def bench(tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> Bench:
    """Runs the command briefly with the tiny network; what it prints."""

    def run(*arguments: object) -> str:
        options = ["--model", tiny_checkpoint, "--size", "64x48", "--threads", 1, "--rounds", 1, "--seconds", 0.05]
        assert main(["bench", "speed", *map(str, [*options, *arguments])]) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return run


def test_rows_follow_from_what_was_measured(bench: Bench, tiny_checkpoint: Path) -> None:
    record = json.loads(bench("--format", "torchscript", "--json"))
    net, _ = nn.load_checkpoint(tiny_checkpoint)
    assert record["flops"] == 2 * nn.count_macs(net.config, 48, 64)
    assert record["parameters"] == nn.count_parameters(net)
    assert record["threads"] == 1 and record["size"] == [64, 48]
    engine, script = record["rows"]
    assert (engine["name"], script["name"]) == ("engine", "torchscript")
    for row in (engine, script):
        assert row["missing"] is None and row["runs"] >= speed_worker.MIN_RUNS
        assert 0 < row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"]
        assert row["flops_per_s"] == pytest.approx(record["flops"] / row["p50_ms"] * 1000)
        assert row["share_of_matrix_product"] == pytest.approx(row["flops_per_s"] / record["matrix_flops_per_s"])
        assert row["peak_bytes"] > 50e6  # torch alone
    assert engine["file_bytes"] == tiny_checkpoint.stat().st_size and engine["max_abs_difference"] is None
    assert script["max_abs_difference"] < 1e-5
    assert {row["platform"]: row["ms"] for row in record["paper_hardware"]}["NVIDIA Jetson TX2"] == 49.0


def test_tables_name_machine_versions_and_the_papers_hardware(bench: Bench, tmp_path: Path) -> None:
    text = bench("--format", "none", "--out", tmp_path / "out")
    assert (tmp_path / "out" / "speed.md").read_text() == text
    assert json.loads((tmp_path / "out" / "speed.json").read_text())["rounds"] == 1
    for expected in (cpu_model(), f"ajna {ajna.__version__}", "load average", "1 threads", "Matrix rate"):
        assert expected in text
    tables = [
        [line for line in part.splitlines() if line.startswith("|")] for part in text.split("The paper's hardware")
    ]
    assert [len(table) for table in tables] == [3, 2 + len(speed.PAPER_HARDWARE) + 1]
    for table in tables:
        assert len({line.count("|") for line in table}) == 1
    assert "this machine" in tables[1][-1] and tables[1][-1].endswith("| here |")


def test_formats_without_software_say_what_to_install(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tiny_checkpoint: Path
) -> None:
    monkeypatch.setattr(exports, "missing", lambda name: None if name == "torchscript" else f"pip install {name}-tool")
    record = json.loads(bench("--json"))
    rows = {row["name"]: row for row in record["rows"]}
    assert list(rows) == [speed.ENGINE, *exports.FORMATS]
    assert rows["onnx"]["missing"] == "needs pip install onnx-tool" and rows["onnx"]["p50_ms"] is None
    assert rows["torchscript"]["missing"] is None
    # Asked for by name it is an error, not a row.
    command = ["bench", "speed", "--model", str(tiny_checkpoint), "--size", "64x48", "--format"]
    assert main([*command, "onnx"]) == 2 and "pip install onnx-tool" in capsys.readouterr().err
    assert main([*command, "onyx"]) == 2 and "did you mean 'onnx'" in capsys.readouterr().err


def test_low_precision_without_instructions_is_called_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "cpu_flags", lambda: frozenset({"avx2"}))
    assert "emulated" in str(speed.emulation("torchscript-bf16")) and "VNNI" in str(speed.emulation("openvino-int8"))
    assert speed.emulation("onnx") is None
    monkeypatch.setattr(speed, "cpu_flags", lambda: frozenset({"avx512_bf16", "avx512_vnni"}))
    assert speed.emulation("torchscript-bf16") is None and speed.emulation("openvino-int8") is None


def test_a_format_that_fails_is_named(tiny_checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.pt").write_bytes(b"no model")
    broken = {"torchscript": speed.File(tmp_path / "broken.pt", 8, 0.0, 0.0)}
    with pytest.raises(RuntimeError, match="measuring 'torchscript' failed"):
        speed.measure(tiny_checkpoint, broken, size=(64, 48), threads=1, rounds=1, seconds=0.01)


def test_measuring_is_bounded_and_warms_up() -> None:
    calls: list[int] = []
    times = speed_worker.measure(lambda: calls.append(1), seconds=60, max_runs=7)
    assert len(times) == 7 and len(calls) == 7 + speed_worker.WARM_UP_RUNS and statistics.median(times) >= 0
    calls.clear()
    assert len(speed_worker.measure(lambda: calls.append(1), seconds=0, max_runs=7)) == speed_worker.MIN_RUNS
    assert speed_worker.peak_bytes() > 0


def test_the_command_offers_every_format() -> None:
    assert [item.value for item in ExportFormat] == list(exports.FORMATS)
