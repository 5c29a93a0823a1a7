# SPDX-License-Identifier: MIT
"""``ajna study``: experiments that hold a claim against measurements."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ajna.cli.options import JsonOption
from ajna.cli.outputs import check_folder, staged_folder

study = typer.Typer(
    name="study",
    help="Experiments that hold a claim against measurements.",
    epilog="Example: ajna study loss --out out",
    no_args_is_help=True,
)


@study.callback()
def _group() -> None:
    """Keeps ``loss`` a subcommand, though it is the only one."""


@study.command()
def loss(
    out: Annotated[
        Path | None, typer.Option(help="Folder for loss_study.md, loss_study.json and images/loss_study.png.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of data and weights.")] = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps; fewer than the default may fail.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Does the uncertainty of every published loss mean what kappa says, and do the misprints fail as predicted?

    Small networks, one for every loss and kind of noise; about a minute. The exit code is 1 where a claim fails.

    Example: ajna study loss --out result
    """
    if out is not None:
        check_folder(out)
    result = _run(seed, steps)
    record = json.dumps(result.record(), indent=2)
    if out is not None:
        _write(out, result, record)
    if as_json:
        typer.echo(record)
    else:
        _print(result)
    if not result.holds:
        raise typer.Exit(1)


def _run(seed: int, steps: int | None) -> Any:
    import time

    from rich.console import Console
    from rich.progress import Progress

    from ajna.studies import loss_study, printed_forms
    from ajna.studies.report import Study

    options = loss_study.StudyOptions(seed=seed)
    if steps is not None:
        options.steps = steps
    start = time.perf_counter()
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        networks, bins = bar.add_task("networks", total=1.0), bar.add_task("printed forms", total=1.0)
        cells = loss_study.run(options, lambda share: bar.update(networks, completed=share))
        printed = printed_forms.run(
            printed_forms.PrintedOptions(seed=seed), lambda share: bar.update(bins, completed=share)
        )
    return Study(cells, printed, seed, options.steps, time.perf_counter() - start)


def _write(out: Path, result: Any, record: str) -> None:
    from PIL import Image

    from ajna.studies.report import draw, markdown

    with staged_folder(out) as stage, staged_folder(out / "images") as pictures:
        (stage / "loss_study.md").write_text(markdown(result, "images/loss_study.png"))
        (stage / "loss_study.json").write_text(record + "\n")
        Image.fromarray(draw(result)).save(pictures / "loss_study.png", optimize=True)


def _print(result: Any) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 200)
    noises = list(dict.fromkeys(cell.noise for cell in result.cells))
    table = Table(title="rho(Y, E[f]) and the largest |kappa(Y) / E[f] - 1| over the grid")
    for column in ("presets", *noises):
        table.add_column(column, overflow="fold")
    for names in dict.fromkeys(tuple(cell.presets) for cell in result.cells):
        cells = {cell.noise: cell for cell in result.cells if tuple(cell.presets) == names}
        texts = (f"{cell.rho:.3f} {100 * cell.deviation:.1f} %" for cell in (cells[noise] for noise in noises))
        table.add_row(", ".join(names), *texts)
    console.print(table)
    for form in result.printed:
        verdict = "as predicted" if form.holds else "[red]not as predicted[/red]"
        console.print(
            f"[bold]{form.preset}[/bold] from raw = {form.start:g}: {escape(form.sentence())}. "
            f"Measured: {escape(form.outcome())}; {verdict}."
        )
    failures = result.failures
    console.print(f"all claims hold ({result.seconds:.0f} s)" if not failures else f"claims that fail: {len(failures)}")
    for text in failures:
        console.print(f"  {escape(text)}")
