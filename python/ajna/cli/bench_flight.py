# SPDX-License-Identifier: MIT
"""``ajna bench flight``: the flight program's latency from capture to command, and its memory over time."""

from __future__ import annotations

import os
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from ajna.cli.options import JsonOption, ModelOption, parse_size

CHECKPOINT = "checkpoint"
FORMATS = {CHECKPOINT: "checkpoint float32", "torchscript": "TorchScript float32"}
FORMATS["torchscript-bf16"] = "TorchScript bfloat16"


def flight(
    program: Annotated[
        Path | None, typer.Option(help="The program; by default $AJNA_FLIGHT_PROGRAM, or ajna_flight on the PATH.")
    ] = None,
    model: ModelOption = "best",
    file_format: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help=f"What it flies with: {', '.join(FORMATS)}; may be repeated or comma-separated. "
            "[default: checkpoint,torchscript]",
        ),
    ] = None,
    task: Annotated[str, typer.Option(help="dodge, navigate or gap.")] = "dodge",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames and of the network.")] = "320x240",
    threads: Annotated[
        list[int] | None, typer.Option(min=1, max=1024, help="CPU threads of the network; repeatable. [default: all]")
    ] = None,
    rate: Annotated[float, typer.Option(help="Frames per second of the camera.")] = 30.0,
    planning_rate: Annotated[
        float | None, typer.Option(help="task.planning_rate_hz of its configuration. [default: the camera's rate]")
    ] = None,
    seconds: Annotated[float, typer.Option(help="How long each flies; 3600 for a soak test.")] = 60.0,
    out: Annotated[Path | None, typer.Option(help="Folder for flight.md and flight.json.")] = None,
    as_json: JsonOption = False,
) -> None:
    """The flight program at its real rate beside a simulated autopilot: latency percentiles, frames, CPU and memory.

    Example: ajna bench flight --program build/release/cpp/apps/ajna_flight --out out/flight

    Nothing real is flown: camera and autopilot are simulated on this machine, and commands go to 127.0.0.1 alone. Needs
    pymavlink.
    """
    from rich.console import Console

    from ajna.benchmarks.flight import measure
    from ajna.cli.bench import split
    from ajna.cli.outputs import check_folder, print_report, staged_folder, write_report
    from ajna.cli.speed import exported
    from ajna.flight_program import find_program
    from ajna.model import checkpoint_path

    try:
        import pymavlink  # noqa: F401
    except ImportError as error:
        raise ValueError("flying against a simulated autopilot needs pymavlink: pip install pymavlink") from error
    parsed = parse_size(size)
    assert parsed is not None
    names = split(file_format) or [CHECKPOINT, "torchscript"]
    unknown = [name for name in names if name not in FORMATS]
    if unknown:
        raise ValueError(f"the flight program does not fly with '{unknown[0]}'; known are {', '.join(FORMATS)}.")
    if out is not None:
        check_folder(out)
    executable, checkpoint = find_program(program), checkpoint_path(model)
    with (
        staged_folder(out) if out is not None else nullcontext() as stage,
        tempfile.TemporaryDirectory(prefix="ajna-flight-models-") as folder,
        Console(stderr=True).status("starting") as status,
    ):
        scripts = [name for name in names if name != CHECKPOINT]
        written, _ = exported(
            checkpoint, scripts, parsed, Path(folder), True, lambda name: status.update(f"writing {name}")
        )
        result = measure(
            executable,
            {FORMATS[name]: checkpoint if name == CHECKPOINT else written[name].path for name in names},
            task=task,
            size=parsed,
            threads=threads or [len(os.sched_getaffinity(0))],
            rate_hz=rate,
            planning_hz=planning_rate,
            seconds=seconds,
            on_turn=lambda label, count: status.update(f"{label}, {count} threads"),
        )
        write_report(result, "flight", stage)
    print_report(result, as_json)
