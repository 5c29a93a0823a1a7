# SPDX-License-Identifier: MIT
"""The command line of packing: train/pack.py."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from ajna.cli.errors import run
from ajna.cli.options import parse_size

app = typer.Typer(add_completion=False)


@app.command()
def pack(
    out: Annotated[Path, typer.Option(help="Folder of the pack.")],
    dataset: Annotated[str | None, typer.Option(help="Kind of data set: chairs2, things3d, sintel, pairs, ...")] = None,
    root: Annotated[Path | None, typer.Option(help="Folder of the data set.")] = None,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT to resize to, or 'native'.")] = "native",
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the data set, e.g. split=val; may be repeated."),
    ] = None,
    skip_bad: Annotated[bool, typer.Option(help="Leave bad samples out and list them, instead of stopping.")] = False,
    chunk: Annotated[int, typer.Option(min=1, help="Samples per file: what a kill loses at most.")] = 64,
    workers: Annotated[int | None, typer.Option(min=1, help="Threads that decode; by default one per CPU.")] = None,
    dry_run: Annotated[bool, typer.Option(help="Only say how large the pack would be.")] = False,
    verify: Annotated[bool, typer.Option(help="Only compare the checksums of the pack in --out.")] = False,
) -> None:
    """Decode a data set once, into files that training maps into memory.

    Example: python train/pack.py --dataset chairs2 --root FlyingChairs2 --set backward=true --out packs/chairs2

    Killed or stopped, the same command goes on where it was.
    """
    if verify:
        _verify(out)
        return
    from ajna.data.pack import estimate
    from ajna.data.pack import pack as run_pack
    from ajna.data.registry import open_dataset, parse_options

    if dataset is None or root is None:
        raise ValueError("what to pack is missing: give --dataset and --root (or --verify).")
    packed_size = None if size == "native" else parse_size(size)
    options = parse_options(option)
    data = open_dataset(dataset, root, skip_bad=skip_bad, options=options)
    expected = estimate(data, packed_size)
    about = "" if packed_size else "about "
    typer.echo(
        f"{expected.samples} samples with {', '.join(expected.parts)}: {about}{_readable(expected.bytes)} in '{out}'"
    )
    if expected.left_out:
        typer.echo(f"not packed, because only some samples have it: {', '.join(expected.left_out)}")
    if dry_run:
        return
    with _progress("packing") as on_progress:
        report = run_pack(
            data,
            out,
            source={"dataset": dataset, "options": options},
            size=packed_size,
            chunk_samples=chunk,
            workers=workers,
            on_progress=on_progress,
        )
    resumed = f", {report.resumed} of them from before" if report.resumed else ""
    typer.echo(f"packed {report.samples} samples{resumed}, {_readable(report.bytes)}, into '{out}'")
    if report.bad:
        typer.echo(f"left out {len(report.bad)} bad samples:")
        for name, reason in report.bad.items():
            typer.echo(f"  {name}: {reason}")


def _verify(out: Path) -> None:
    from ajna.data.packed import PackedDataset

    data = PackedDataset(out)
    with _progress("verifying") as on_progress:
        data.verify(on_progress)
    typer.echo(f"'{out}' is whole: {len(data)} samples, {_readable(data.bytes)}")


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr; yields the function that moves it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _readable(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1024
    raise AssertionError("unreachable")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (default: those of the process); returns the exit code."""
    return run(app, argv)
