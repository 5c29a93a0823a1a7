# SPDX-License-Identifier: MIT
"""How fast the model is on this machine, in the engine and in every exported format, beside the paper's hardware.

Each format runs in processes of its own, in turns: a machine that becomes busy slows all of them, and the memory is
that of one format alone. All are timed from two uint8 frames in memory to flow, uncertainty and expected error in
memory. Between the turns the machine's float32 matrix product is measured, the rate that the network is held against.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import ajna
from ajna import nn
from ajna.benchmarks.machine import cpu_flags, describe_machine, describe_versions
from ajna.benchmarks.uncertainty import percentile
from ajna.exports import FORMATS, runners

ENGINE = "engine"
LABELS = {ENGINE: "Ajna engine float32", **{name: kind.label for name, kind in FORMATS.items()}}
MATRIX_SIDE = 1024  # a product of this side takes about as long as a layer or two, and its matrices fit the caches

#: Section "Network speed on different hardware": platform, milliseconds a pair, batch 1.
PAPER_HARDWARE = (
    ("Intel i9 CPU", 140.7),
    ("NVIDIA Titan Xp GPU", 9.1),
    ("NVIDIA Jetson TX2", 49.0),
    ("Intel NCS2", 268.9),
    ("Google Coral TPU", 34.4),
)

OnTurn = Callable[[str, int], None]


@dataclass(frozen=True)
class File:
    """An exported file to be measured."""

    path: Path
    size_bytes: int
    max_abs_difference: float  # of the raw output, to the network
    flow_difference_px: float


@dataclass(frozen=True)
class Row:
    """One format. Figures are None where it was not measured, and `missing` says why."""

    name: str
    label: str
    missing: str | None = None
    note: str | None = None
    runs: int | None = None
    p50_ms: float | None = None
    p95_ms: float | None = None
    p99_ms: float | None = None
    peak_bytes: int | None = None
    file_bytes: int | None = None
    max_abs_difference: float | None = None
    flow_difference_px: float | None = None
    flops_per_s: float | None = None  # at the median
    share_of_matrix_product: float | None = None


@dataclass(frozen=True)
class Speed:
    """The tables and what they depend on."""

    rows: tuple[Row, ...]
    size: tuple[int, int]  # (width, height)
    threads: int
    rounds: int
    seconds: float
    model: dict[str, str]
    parameters: int
    flops: int
    matrix_side: int
    matrix_flops_per_s: float
    machine: dict[str, Any]
    load_average_after: float
    nice: int
    versions: dict[str, str]
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain keys and numbers, null where there is none; the paper's hardware, too."""
        paper = [{"platform": name, "ms": ms} for name, ms in PAPER_HARDWARE]
        return {**asdict(self), "paper_hardware": paper}

    def to_markdown(self) -> str:
        """This machine's table, the paper's with this machine's rows, and what both were measured with."""
        from ajna.benchmarks.speed_tables import markdown

        return markdown(self)


def measure(
    checkpoint: Path,
    files: Mapping[str, File],
    missing: Mapping[str, str] | None = None,
    *,
    size: tuple[int, int] = (320, 240),
    threads: int | None = None,
    rounds: int = 3,
    seconds: float = 4.0,
    max_runs: int = 1000,
    notes: Sequence[str] = (),
    on_turn: OnTurn | None = None,
) -> Speed:
    """Measure the engine with `checkpoint` and each of `files` (format -> file).

    Args:
        missing: formats that become rows without figures, and why.
        size: (width, height); that of the files where they fix it.
        threads: of every runtime; by default the cores that this process may use.
        rounds: turns of each format, each in a new process.
        seconds: about how long one turn measures, after its warm-up; at least three runs, at most `max_runs`.
        on_turn: called with (format, round) before each turn.

    Raises:
        RuntimeError: a format's process failed; names it and gives the last line of what it said.
    """
    machine = describe_machine()  # before the load average counts this run
    chosen = threads or len(os.sched_getaffinity(0))
    kinds = {ENGINE: checkpoint, **{name: file.path for name, file in files.items()}}
    times: dict[str, list[float]] = {name: [] for name in kinds}
    peaks = dict.fromkeys(kinds, 0)
    products: list[float] = []
    common = ["--width", *map(str, (size[0], "--height", size[1], "--threads", chosen))]
    for turn in range(rounds):
        for name, path in kinds.items():
            if on_turn is not None:
                on_turn(LABELS[name], turn)
            result = _turn(name, ["--file", str(path), *common], seconds, max_runs)
            times[name] += result["times_ms"]
            peaks[name] = max(peaks[name], result["peak_bytes"])
            product = ["--side", str(MATRIX_SIDE), "--threads", str(chosen)]
            products += _turn("matrix-product", product, min(1.0, seconds), max_runs)["times_ms"]
    net, card = nn.load_checkpoint(checkpoint)
    flops = 2 * nn.count_macs(net.config, size[1], size[0])
    rate = 2 * MATRIX_SIDE**3 / (statistics.median(products) / 1000)
    rows = []
    for name, label in LABELS.items():
        if name in times:
            rows.append(_row(name, times[name], peaks[name], files.get(name), checkpoint, flops, rate))
        elif missing is not None and name in missing:
            rows.append(Row(name, label, missing=missing[name]))
    return Speed(
        rows=tuple(rows),
        size=size,
        threads=chosen,
        rounds=rounds,
        seconds=seconds,
        model={"name": card["name"], "file": checkpoint.name, "sha256": ajna.load(checkpoint).sha256},
        parameters=nn.count_parameters(net),
        flops=flops,
        matrix_side=MATRIX_SIDE,
        matrix_flops_per_s=rate,
        machine=machine,
        load_average_after=round(os.getloadavg()[0], 2),
        nice=os.nice(0),
        versions=describe_versions(("onnxruntime", "openvino", "nncf")),
        notes=tuple(notes),
    )


def emulation(name: str) -> str | None:
    """Why a format of low precision gains nothing on this processor; None where it has the instructions."""
    flags = cpu_flags()
    if not flags:
        return None
    if name.endswith("bf16") and not flags & {"avx512_bf16", "amx_bf16", "avx10_2", "bf16"}:
        return "emulated: this processor has no bfloat16 instructions"
    if name.endswith("int8") and not flags & {"avx512_vnni", "avx_vnni", "amx_int8", "asimddp", "i8mm"}:
        return "this processor has no int8 dot product (VNNI)"
    return None


def _row(name: str, times: list[float], peak: int, file: File | None, checkpoint: Path, flops: int, rate: float) -> Row:
    median = statistics.median(times)
    reached = flops / (median / 1000)
    return Row(
        name,
        LABELS[name],
        note=emulation(name),
        runs=len(times),
        p50_ms=median,
        p95_ms=percentile(times, 95),
        p99_ms=percentile(times, 99),
        peak_bytes=peak,
        file_bytes=checkpoint.stat().st_size if file is None else file.size_bytes,
        max_abs_difference=None if file is None else file.max_abs_difference,
        flow_difference_px=None if file is None else file.flow_difference_px,
        flops_per_s=reached,
        share_of_matrix_product=reached / rate,
    )


def _turn(kind: str, arguments: list[str], seconds: float, max_runs: int) -> dict[str, Any]:
    worker = Path(__file__).with_name("speed_worker.py")
    command = [sys.executable, str(worker), "--kind", kind, "--runners", str(runners.__file__), *arguments]
    command += ["--seconds", str(seconds), "--max-runs", str(max_runs)]
    # The process must find this very package, wherever it was imported from.
    path = [str(Path(ajna.__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        said = (done.stderr.strip() or "nothing").splitlines()[-1]
        raise RuntimeError(f"measuring '{kind}' failed (exit code {done.returncode}): {said}")
    return json.loads(done.stdout.splitlines()[-1])
