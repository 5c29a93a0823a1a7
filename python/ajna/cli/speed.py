# SPDX-License-Identifier: MIT
"""``ajna bench speed``: times and memory of the model on this machine, beside the paper's hardware."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ajna.cli.options import JsonOption, ModelOption, ThreadsOption, parse_size

if TYPE_CHECKING:
    from ajna.benchmarks.speed import File

ALL = "all"


def speed(
    file_format: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help="Beside the engine: all, none, or formats of `ajna export`; may be repeated or comma-separated.",
        ),
    ] = None,
    model: ModelOption = "best",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames, multiples of 16.")] = "320x240",
    threads: ThreadsOption = None,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each format, each in a new process.")] = 3,
    seconds: Annotated[float, typer.Option(min=0.01, help="How long each turn measures, about.")] = 4.0,
    out: Annotated[Path | None, typer.Option(help="Folder for speed.md and speed.json.")] = None,
    as_json: JsonOption = False,
) -> None:
    """The engine and every exported format on this machine: p50, p95, p99, memory, share of the matrix-product rate.

    Example: ajna bench speed --format all --out out/speed

    Prints Markdown: this machine's table, then the paper's hardware table with this machine's rows. Formats whose
    software is not installed stand in the table with what to install. int8 is calibrated on rendered scenes here.
    """
    from rich.console import Console

    from ajna.benchmarks.speed import measure
    from ajna.cli.outputs import check_folder, print_report, staged_folder, write_report
    from ajna.model import checkpoint_path

    parsed = parse_size(size)
    assert parsed is not None
    if out is not None:
        check_folder(out)
    names = _chosen(file_format)
    checkpoint = checkpoint_path(model)
    with (
        staged_folder(out) if out is not None else nullcontext() as stage,
        tempfile.TemporaryDirectory(prefix="ajna-speed-") as folder,
        Console(stderr=True).status("starting") as status,
    ):
        strict = ALL not in (file_format or [ALL])
        files, missing = exported(
            checkpoint, names, parsed, Path(folder), strict, lambda name: status.update(f"writing {name}")
        )
        result = measure(
            checkpoint,
            files,
            missing,
            size=parsed,
            threads=threads,
            rounds=rounds,
            seconds=seconds,
            on_turn=lambda name, turn: status.update(f"{name}, turn {turn + 1} of {rounds}"),
        )
        write_report(result, "speed", stage)
    print_report(result, as_json)


def _chosen(given: Sequence[str] | None) -> list[str]:
    from ajna._core import nearest_name
    from ajna.cli.bench import split
    from ajna.exports import FORMATS

    names = split(given) or [ALL]
    if names == ["none"]:
        return []
    for name in names:
        if name not in FORMATS and name != ALL:
            near = nearest_name(name, list(FORMATS))
            hint = f"did you mean '{near}'?" if near else f"known are {ALL}, none, {', '.join(FORMATS)}."
            raise ValueError(f"unknown format '{name}' to measure; {hint}")
    return list(FORMATS) if ALL in names else [name for name in FORMATS if name in names]


def exported(
    checkpoint: Path,
    names: Sequence[str],
    size: tuple[int, int],
    folder: Path,
    strict: bool,
    on_format: Callable[[str], None],
) -> tuple[dict[str, File], dict[str, str]]:
    """Write each format into `folder`: the files, and why a format is not among them.

    Raises:
        ValueError: `strict`, and a format cannot be written here; or the size does not fit.
    """
    from ajna import exports, nn
    from ajna.benchmarks.speed import File
    from ajna.exports.calibration import inputs_of_scenes
    from ajna.exports.graph import check_size

    net, metadata = nn.load_checkpoint(checkpoint)
    check_size(net, *size)
    files, missing = {}, {}
    for name in names:
        if strict:
            exports.require(name)
        remedy = exports.missing(name)
        if remedy is not None:
            missing[name] = f"needs {remedy}"
            continue
        on_format(name)
        calibration = inputs_of_scenes(*size) if name == "openvino-int8" else None
        path = folder / f"{name}{exports.FORMATS[name].suffixes[0]}"
        report = exports.export(path, net, metadata, name, *size, calibration)
        files[name] = File(path, report.size_bytes, report.difference.raw, report.difference.flow_px)
    return files, missing
