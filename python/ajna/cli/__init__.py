# SPDX-License-Identifier: MIT
"""The command line, ``ajna COMMAND``: one module per command or group.

Commands import what is heavy (torch, OpenCV, matplotlib) inside their functions, so that ``--help`` is quick. They
raise ordinary exceptions; :func:`ajna.cli.errors.run` alone turns those into one sentence and an exit code.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated

import typer

from ajna.cli import errors
from ajna.cli.bench import bench
from ajna.cli.bench_flight import flight
from ajna.cli.calibrate import calibrate
from ajna.cli.evaluate import evaluate
from ajna.cli.export import export
from ajna.cli.info import info
from ajna.cli.losses import losses
from ajna.cli.predict import predict
from ajna.cli.replay import replay
from ajna.cli.sim import add_benchmarks, sim
from ajna.cli.speed import speed
from ajna.cli.study import study
from ajna.cli.synth import app as synth_app
from ajna.cli.task import task
from ajna.cli.video import video

app = typer.Typer(
    name="ajna",
    add_completion=False,
    pretty_exceptions_enable=False,  # errors.run decides what a person sees
    rich_markup_mode="markdown",
    help="Optical flow and its per-pixel uncertainty in one pass.",
    epilog="Example: ajna predict frame1.png frame2.png --out result",
)
for _command in (predict, video, task, sim, replay, evaluate, calibrate, export, info, losses):
    app.command()(_command)
add_benchmarks(bench)
bench.command()(speed)
bench.command()(flight)
app.add_typer(bench, name="bench")
app.add_typer(study)
app.add_typer(synth_app, name="synth")


def _print_version(wanted: bool) -> None:
    if wanted:
        import torch

        from ajna import _core  # a broken extension must fail here, not in the first real command

        typer.echo(f"ajna {_core.__version__} (torch {torch.__version__})")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    traceback: Annotated[bool, typer.Option("--traceback", help="On an error, show where it came from.")] = False,
) -> None:
    errors.show_traceback(traceback)
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line on ``argv`` (without the program's name; by default the process's) and return its exit code.

    0: done; 2: the input or an option is at fault (one sentence on stderr); 1: a bug (traceback); 130: interrupted.
    """
    # OpenCV and FFmpeg would add their own lines to our one sentence; both read these when they are first used.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    return errors.run(app, argv)
