# SPDX-License-Identifier: MIT
"""`ajna sim` and `ajna bench`: fly trials in simulated worlds; the paper's tables beside ours."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import JsonOption, parse_size

if TYPE_CHECKING:
    from ajna.sim.episode import EpisodeResult
    from ajna.sim.trials import Speed

#: The experiments of `ajna.sim.benchmark`, named here because importing it takes MuJoCo.
EXPERIMENTS = ("dodge", "gap", "forest", "indoor-forest", "boxes", "pile")

WorkersOption = Annotated[int, typer.Option(min=1, max=256, help="Worker processes; 1: none beside this one.")]


def sim(
    world: Annotated[str, typer.Argument(metavar="WORLD", help="forest, indoor-forest, boxes, gap, dodge or pile.")],
    out: Annotated[Path, typer.Option(help="Folder of the results; trials found there are not flown again.")],
    method: Annotated[str, typer.Option(help="How to see: depth, d435i, morpheyes, occmask, gapflyt, ...")] = "depth",
    trials: Annotated[int, typer.Option(min=1, help="Number of trials.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first trial; each next one has the next seed.")] = 0,
    weights: Annotated[
        Path | None, typer.Option(help="TorchScript or ONNX file of a method that needs a network.")
    ] = None,
    network_size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size at which that network runs; default: the camera's.")
    ] = None,
    workers: WorkersOption = 1,
    video: Annotated[bool, typer.Option("--video", help="Also write a video of every trial (slower).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Fly trials in a simulated world and say how they went.

    Every trial leaves OUT/WORLD/METHOD/trial_SEED.json; the same command goes on after a kill. summary.json has the
    rates with 95 % intervals, paths.png the first world from above.

    Example: ajna sim forest --method depth --trials 20 --seed 0 --out flights --workers 2
    """
    from ajna.cli.outputs import check_folder
    from ajna.sim.methods import make_method
    from ajna.sim.statistics import summarize
    from ajna.sim.trials import Speed, TrialPlan, run_trials, write_json
    from ajna.sim.worlds import make_world

    check_folder(out)
    size = parse_size(network_size)
    plan = TrialPlan(world, method, trials, seed, out, weights, (size[1], size[0]) if size else None, video)
    _check(plan, make_method(method, weights))
    with _progress(f"{world}, {method}", trials) as advance:
        speed = Speed()
        results = run_trials(plan, workers, advance, speed)
    record = {**summarize(results), "speed": speed.to_json()}
    write_json(plan.folder / "summary.json", record)
    _write_plan_view(plan.folder / "paths.png", make_world(world, seed), method, results)
    if as_json:
        typer.echo(json.dumps(record))
    else:
        typer.echo(_sentence(record))
        if speed.frames_per_s is not None:
            typer.echo(_pace(speed))
        typer.echo(f"wrote {plan.folder}")


def _check(plan: Any, method: Any) -> None:
    """Fail before the first trial where a name is unknown or the method does not do the task."""
    from ajna.sim.benchmark import task_of

    task = task_of(plan.world)
    if task not in method.tasks:
        raise ValueError(
            f"method '{plan.method}' cannot be used in '{plan.world}' ({task}); it does: "
            f"{', '.join(sorted(method.tasks))}"
        )


@contextmanager
def _progress(title: str, total: int) -> Iterator[Callable[[EpisodeResult, bool], None]]:
    """A bar on a terminal, a line per trial elsewhere; both on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[last]}"),
               TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("trials", total=total, last="")
        count = 0

        def advance(result: EpisodeResult, from_file: bool) -> None:
            nonlocal count
            count += 1
            progress.update(task, advance=1, last=f"seed {result.seed}: {result.reason}")
            if not console.is_terminal:
                known = " (from its file)" if from_file else ""
                typer.echo(f"{title}: {count}/{total}, seed {result.seed}: {result.reason}{known}", err=True)

        yield advance


def _percent(record: dict[str, Any], key: str) -> str:
    low, high = record[f"{key}_ci"]
    return f"{record[key]:.0%} [{low:.0%}, {high:.0%}]"


def _sentence(record: dict[str, Any]) -> str:
    parts = [f"{record['world']}, {record['method']}: success {_percent(record, 'success_rate')}"]
    parts[0] += f" of {record['trials']} trials"
    if record["mean_speed_m_s"] is not None and record["mean_speed_m_s"] > 0:
        parts.append(f"{record['cruise_speed_m_s']:.1f} m/s")
    if record["path_increase_percent"] is not None:
        parts.append(f"path {record['path_increase_percent']:+.1f} %")
    if record["safe_point_error_px"] is not None:
        parts.append(f"safe point off by {record['safe_point_error_px']:.1f} px")
    if record["detection_rate"] is not None:
        parts.append(f"detected {_percent(record, 'detection_rate')}")
    if record["run_time_ms"] is not None:
        parts.append(f"{record['run_time_ms']:.1f} ms a frame")
    return ", ".join(parts)


def _pace(speed: Speed) -> str:
    """How fast was flown, on one line."""
    workers = f"{speed.workers} worker{'s' if speed.workers > 1 else ''}"
    return f"{speed.frames} frames in {speed.seconds:.1f} s: {speed.frames_per_s:.1f} frames/s with {workers}"


def _write_plan_view(path: Path, world: Any, method: str, results: list[EpisodeResult]) -> None:
    import os

    from ajna.sim.plot import plan_view

    temporary = path.with_name(f".{path.name}.tmp.png")
    try:
        plan_view(world, {method: results}).savefig(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def add_benchmarks(group: typer.Typer) -> None:
    """Add one command per experiment to `ajna bench`."""
    for experiment in EXPERIMENTS:
        group.command(name=experiment)(_benchmark(experiment))
    group.command(name="report")(report)


def _benchmark(experiment: str) -> Callable[..., None]:
    def command(
        out: Annotated[
            Path, typer.Option(help="Folder of the trials and of the table; trials there are not flown again.")
        ],
        trials: Annotated[int, typer.Option(min=1, help="Trials of each method.")] = 50,
        seed: Annotated[int, typer.Option(min=0, help="Seed of the first trial.")] = 0,
        method: Annotated[
            list[str] | None, typer.Option(help="Only this method; may be repeated. Default: all of the experiment.")
        ] = None,
        weights: Annotated[
            list[str] | None,
            typer.Option(metavar="METHOD=FILE", help="A method's TorchScript or ONNX file; repeatable."),
        ] = None,
        workers: WorkersOption = 1,
        as_json: JsonOption = False,
    ) -> None:
        run_benchmark(experiment, out, trials, seed, method, weights, workers, as_json)

    command.__doc__ = f"""The paper's {experiment} table with what is measured here beside it, as Markdown and JSON.

    Methods whose weights are not given stand in the table without numbers.

    Example: ajna bench {experiment} --trials 50 --out flights --workers 2
    """
    return command


def run_benchmark(
    experiment: str,
    out: Path,
    trials: int,
    seed: int,
    method: list[str] | None,
    weights: list[str] | None,
    workers: int,
    as_json: bool,
) -> None:
    """Fly what is missing and write the table; see the command's options."""
    from ajna.cli.outputs import check_folder
    from ajna.sim.benchmark import as_markdown, cost_of, rows_of
    from ajna.sim.statistics import summarize
    from ajna.sim.trials import Speed, TrialPlan, run_trials, write_json

    check_folder(out)
    files = _weights(weights or [])
    rows = rows_of(experiment, method)
    for name in files:
        if name not in {row.method for row in rows}:
            raise ValueError(f"--weights {name}=...: '{name}' is not a method of '{experiment}'")
    for row in rows:
        if row.needs_weights and row.method not in files:
            continue
        plan = TrialPlan(experiment, row.method, trials, seed, out, files.get(row.method))
        speed = Speed()
        with _progress(f"{experiment}, {row.method}", trials) as advance:
            results = run_trials(plan, workers, advance, speed)
        row.measured = {**summarize(results), "speed": speed.to_json()}
        row.cost = cost_of(row.method, files.get(row.method))
        if speed.frames_per_s is not None:
            typer.echo(f"{experiment}, {row.method}: {_pace(speed)}", err=True)
    records = [row.to_json() for row in rows]
    write_json(out / f"bench_{experiment}.json", {"experiment": experiment, "seed": seed, "rows": records})
    table = as_markdown(experiment, rows)
    (out / f"bench_{experiment}.md").write_text(table + "\n", encoding="utf-8")
    typer.echo(json.dumps(records) if as_json else table)


def report(
    out: Annotated[Path, typer.Option(help="Folder of the trials, as given to `ajna bench WORLD`.")],
    markdown: Annotated[
        Path, typer.Option(help="Page to write the tables into; the rest of it stays. A JSON file comes beside it.")
    ],
    keep: Annotated[
        bool, typer.Option("--keep/--fresh", help="Keep rows of that JSON file whose trials are not in the folder.")
    ] = True,
) -> None:
    """All tables from the trials that lie in a folder, whatever their number; flies nothing.

    The tables go between two marks in the page (appended where it has none); each row says how many trials it has. Rows
    of which the folder has no trials stay as they were, but for those of another shipped model.

    Example: ajna bench report --out flights --markdown docs/results.md
    """
    from ajna.sim.report import write_report

    tables = write_report(out, markdown, keep)
    rows = [row for table in tables.values() for row in table if row.measured is not None]
    trials = sum(row.measured["trials"] for row in rows if row.measured is not None)
    typer.echo(f"{len(rows)} rows of {trials} trials")
    typer.echo(f"wrote {markdown} and {markdown.with_suffix('.json')}")


def _weights(pairs: list[str]) -> dict[str, Path]:
    """['midas=file.pt'] -> {'midas': Path('file.pt')}."""
    files = {}
    for pair in pairs:
        name, equals, file = pair.partition("=")
        if not (name and equals and file):
            raise ValueError(f"--weights '{pair}' is not METHOD=FILE: give for example --weights midas=midas.pt")
        files[name] = Path(file)
    return files
