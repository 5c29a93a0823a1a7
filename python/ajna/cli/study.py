# SPDX-License-Identifier: MIT
"""``ajna study``: experiments that hold a claim against measurements."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ajna.cli.options import DeviceOption, JsonOption, ModelOption
from ajna.cli.outputs import check_folder, staged_folder

study = typer.Typer(
    name="study",
    help="Experiments that hold a claim against measurements.",
    epilog="Example: ajna study loss --out out",
    no_args_is_help=True,
)


@study.callback()
def _group() -> None:
    """Keeps each study a subcommand."""


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


@study.command()
def robustness(
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for robustness.md, robustness.json and two pictures in images/."),
    ] = None,
    model: ModelOption = "best",
    scenes: Annotated[int, typer.Option(min=2, help="Number of scenes, each with textures of its own.")] = 120,
    patch_steps: Annotated[
        int, typer.Option(min=0, help="Steps of the attack that makes a patch; 0: without patches.")
    ] = 120,
    surrogate: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Another checkpoint: a patch made against it is shown to the model."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of scenes, disturbances and patches.")] = 0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the scenes.")] = "320x240",
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Do boundaries dominate the uncertainty under lamps, low texture, noise, rain, ... and an adversarial patch?

    The full run takes about a quarter of an hour on one core; --scenes 6 --patch-steps 5 shows what it does.

    Example: ajna study robustness --scenes 120 --out result
    """
    from ajna.cli.options import parse_size
    from ajna.studies.robustness import RobustnessOptions

    if out is not None:
        check_folder(out)
    wanted = parse_size(size)
    assert wanted is not None
    options = RobustnessOptions(scenes, seed, *wanted)
    result, patches, network = _measure_robustness(model, device, options, patch_steps, surrogate)
    record = json.dumps(result.record(), indent=2)
    if out is not None:
        _write_robustness(out, result, patches, network, record)
    if as_json:
        typer.echo(record)
    else:
        _print_robustness(result)


@study.command("false-alarms")
def false_alarms(
    model: ModelOption = "best",
    rooms: Annotated[int, typer.Option(min=1, help="Number of rooms.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first room; each next one has the next seed.")] = 0,
    duration: Annotated[float, typer.Option(help="Seconds that each room is watched for.")] = 2.0,
    as_json: JsonOption = False,
) -> None:
    """How often a hovering vehicle dodges nothing: simulated rooms without a throw, under steady and blinking light.

    Example: ajna study false-alarms --rooms 20
    """
    from rich.console import Console
    from rich.progress import Progress

    from ajna.sim.methods.signals import NetworkSignal
    from ajna.studies import false_alarms as study_of

    options = study_of.FalseAlarmOptions(rooms, seed, duration)
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("rooms", total=1.0)
        conditions = study_of.run(
            NetworkSignal(model), options, progress=lambda share: bar.update(task, completed=share)
        )
    if as_json:
        typer.echo(json.dumps([condition.record() for condition in conditions]))
    else:
        typer.echo(study_of.markdown(conditions, options))


@study.command()
def presets(
    model: Annotated[
        list[str] | None, typer.Option(help="Model by name, checkpoint or TorchScript file; may be repeated.")
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="Classical method beside it: dis, farneback or zero; may be repeated.")
    ] = None,
    scenes: Annotated[int, typer.Option(min=2, help="Number of scenes of each preset.")] = 32,
    preset: Annotated[
        list[str] | None, typer.Option(help="Only this preset; may be repeated. Default: all (`ajna synth presets`).")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of scenes and textures.")] = 1,
    align: Annotated[
        bool, typer.Option("--align", help="Each model once more on pairs without the motion of their largest plane.")
    ] = False,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the scenes.")] = "320x240",
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Flow, uncertainty, intervals and boundaries on held-out synthetic scenes of every preset.

    Example: ajna study presets --model best --method dis --scenes 32
    """
    from rich.console import Console
    from rich.progress import Progress

    import ajna
    from ajna.baselines import make_baseline, with_aligned
    from ajna.cli.options import parse_size
    from ajna.studies import presets as study_of

    wanted = parse_size(size)
    assert wanted is not None
    options = study_of.PresetOptions(scenes, seed, *wanted, tuple(preset or ()))
    methods: dict[str, Any] = {name: ajna.load(name, device=device) for name in model or ["best"]}
    if align:
        methods = with_aligned(methods)
    methods |= {name: make_baseline(name) for name in method or []}
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("scenes", total=1.0)
        rows = study_of.run(methods, options, lambda share: bar.update(task, completed=share))
    typer.echo(json.dumps([row.record() for row in rows]) if as_json else study_of.markdown(rows, options))


@study.command()
def horizon(
    model: ModelOption = "best",
    forests: Annotated[int, typer.Option(min=1, help="Number of forests, flown by true depth.")] = 4,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the first forest; from 1000 on they are apart from those of trials.")
    ] = 1002,
    as_json: JsonOption = False,
) -> None:
    """Fit the law by which navigating reads distances from a network's uncertainty along the horizon.

    For task.navigate.horizon of flight.yaml, where another network flies. About a minute a forest on one core.

    Example: ajna study horizon --model mine.safetensors
    """
    from rich.console import Console
    from rich.progress import Progress

    from ajna.sim.methods.signals import NetworkSignal
    from ajna.studies import horizon as study_of

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("forests", total=1.0)
        result = study_of.run(
            NetworkSignal(model), forests, seed, progress=lambda share: bar.update(task, completed=share)
        )
    typer.echo(json.dumps(result.record()) if as_json else study_of.markdown(result))


def _measure_robustness(model: str, device: str, options: Any, patch_steps: int, surrogate: Path | None) -> Any:
    import time

    from rich.console import Console
    from rich.progress import Progress

    import ajna
    from ajna.model import checkpoint_path
    from ajna.studies import robustness as study_of
    from ajna.studies.disturbances import Patch, make_scene
    from ajna.studies.patch_attack import AttackOptions, random_patch, train_patch

    start = time.perf_counter()
    network = ajna.load(model, device=device)
    attacks: dict[str, Path] = {}
    notes = []
    if patch_steps:
        attacks["patch, white box"] = checkpoint_path(model)
        if surrogate is not None:
            if not surrogate.is_file():
                raise FileNotFoundError(f"surrogate '{surrogate}' does not exist: give the file of a checkpoint")
            attacks["patch, transferred"] = checkpoint_path(surrogate)
        else:
            notes.append("a patch made against another network, as no --surrogate was given")
    else:
        notes.append("patches, as --patch-steps is 0")
    patches: dict[str, Patch] = {}
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        if attacks:
            attack = AttackOptions(steps=patch_steps, seed=options.seed)
            patches["patch, random"] = random_patch(attack.side, options.seed)
            # Scenes beyond those that are judged.
            numbers = range(options.scenes, options.scenes + options.attacked)
            training = [make_scene(n, options.seed, options.width, options.height) for n in numbers]
            for name, checkpoint in attacks.items():
                task = bar.add_task(name, total=1.0)

                def advance(share: float, task: Any = task) -> None:
                    bar.update(task, completed=share)

                patches[name] = train_patch(checkpoint, training, attack, advance)
        scenes = bar.add_task("scenes", total=1.0)
        conditions = study_of.run(
            network, options, list(patches.items()), progress=lambda share: bar.update(scenes, completed=share)
        )
    seconds = time.perf_counter() - start
    return study_of.RobustnessStudy(options, network.info.name, conditions, notes, seconds), patches, network


def _write_robustness(out: Path, result: Any, patches: dict[str, Any], network: Any, record: str) -> None:
    from PIL import Image

    from ajna.studies.robustness_report import draw, examples, markdown

    with staged_folder(out) as stage, staged_folder(out / "images") as pictures:
        page = markdown(result, "images/robustness.png", "images/robustness_examples.jpg")
        (stage / "robustness.md").write_text(page, encoding="utf-8")
        (stage / "robustness.json").write_text(record + "\n", encoding="utf-8")
        Image.fromarray(draw(result)).save(pictures / "robustness.png", optimize=True)
        sheet = examples(network, result.options, patches)
        Image.fromarray(sheet).save(pictures / "robustness_examples.jpg", quality=88)


def _print_robustness(result: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"uncertainty over {result.options.scenes} scenes: medians, 95 % intervals")
    ratios = ("over_flat", "px_over_flat", "above_flat_share")
    keys = ("boundary", "flat", "textured", "touched", *ratios, "auc", "change_px")
    for column in ("disturbance", *keys):
        table.add_column(column)
    for condition in result.conditions:
        record = condition.record()
        cells = []
        for key in keys:
            value, interval = record[key], record[f"{key}_ci"]
            cells.append("–" if value is None else f"{value:.2f} [{interval[0]:.2f}, {interval[1]:.2f}]")
        table.add_row(condition.name, *cells)
    console = Console(width=None if sys.stdout.isatty() else 220)
    console.print(table)
    for note in result.notes:
        console.print(f"not measured: {note}")
