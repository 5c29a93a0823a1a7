# SPDX-License-Identifier: MIT
"""`ajna calibrate`: fit expected errors and intervals on held-out images."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import DeviceOption, JsonOption, ThreadsOption, parse_size
from ajna.data.registry import DATASETS, open_dataset, parse_options

if TYPE_CHECKING:
    from ajna.calibration import CalibrationResult, HeldOut

SYNTHETIC = "synthetic"
_DEFAULT_SIZE = "320x240"
_DEFAULT_SCENES = 400


def calibrate(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Shipped model by name, or a checkpoint.")],
    out: Annotated[Path, typer.Option(help="The calibrated checkpoint to write (.safetensors).", show_default=False)],
    dataset: Annotated[
        str, typer.Option(metavar="NAME", help=f"Kind of data set: {SYNTHETIC}, {', '.join(DATASETS)}.")
    ] = SYNTHETIC,
    root: Annotated[Path | None, typer.Option(help="Folder of the data set; not for synthetic scenes.")] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the data set or the scenes, e.g. pass_name=final."),
    ] = None,
    skip_bad: Annotated[bool, typer.Option(help="Count and list unreadable pairs instead of stopping.")] = False,
    size: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT at which the model will run, or 'full' for each pair's own.")
    ] = _DEFAULT_SIZE,
    scenes: Annotated[int, typer.Option(min=3, help="Number of synthetic scenes.")] = _DEFAULT_SCENES,
    photos: Annotated[Path | None, typer.Option(help="Photographs as textures of synthetic scenes, too.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the split, and of synthetic scenes.")] = 0,
    levels: Annotated[
        str | None, typer.Option(metavar="P,P,...", help="Shares of the intervals; by default 0.5 to 0.99 as possible.")
    ] = None,
    weighting: Annotated[str, typer.Option(help="'image': each image counts alike; 'pixel': each pixel.")] = "image",
    group: Annotated[
        str | None,
        typer.Option(
            metavar="REGEX", help="Images whose names agree in its first group stay in one part, e.g. '(.*)/'."
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG of reliability and coverage, before and after.")] = None,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit what uncertainty means in pixels, and intervals with a stated coverage, on images not trained on.

    40 % of the images fit the expected error, 40 % the intervals; what is printed is measured on the remaining 20 %.

    Example: ajna calibrate best --dataset sintel --root data/sintel --out best-calibrated.safetensors
    """
    shape = None if size == "full" else parse_size(size)
    shares = None if levels is None else _levels(levels)
    grouping = None if group is None else _grouping(group)
    if dataset == SYNTHETIC:
        _refuse_for_synthetic(root, shape)
    elif root is None:
        raise ValueError(f"data set '{dataset}' needs its folder: give --root DIR")
    elif photos is not None:
        raise ValueError("--photos are textures of synthetic scenes: give it with --dataset synthetic only")
    if out.suffix != ".safetensors" or out.is_dir():
        raise ValueError(f"output '{out}': give --out the name of a file that ends in .safetensors")
    if plot is not None and (plot.suffix != ".png" or plot.is_dir()):
        raise ValueError(f"plot '{plot}': give --plot the name of a file that ends in .png")

    from contextlib import ExitStack

    import torch
    from rich.console import Console

    from ajna.calibration import PairSource, SyntheticScenes, fit, reliability_plot
    from ajna.cli.outputs import check_folder, made_folder

    targets = [path.parent for path in (out, plot) if path is not None]
    for folder in targets:
        check_folder(folder)
    if threads is not None:
        torch.set_num_threads(threads)
    pairs: PairSource
    if dataset == SYNTHETIC:
        assert shape is not None
        scene = _scene_options(parse_options(option))
        pairs, described = SyntheticScenes(scenes, *shape, seed=seed, photos=photos, scene=scene), None
    else:
        assert root is not None
        pairs = open_dataset(dataset, root, skip_bad=skip_bad, options=parse_options(option), scoring=True)
        described = f"{dataset} in {root.name}"
    with ExitStack() as stack:
        status = stack.enter_context(Console(stderr=True).status("starting"))
        result = fit(
            model,
            pairs,
            levels=shares,
            weighting=weighting,
            seed=seed,
            group=grouping,
            size=shape,
            data=described,
            device=device,
            on_pair=lambda number, total, name: status.update(f"{number} of {total}: {name}"),
        )
        for folder in targets:
            stack.enter_context(made_folder(folder))
        if plot is not None:
            from ajna import io

            title = f"{result.metadata.name}, {result.images['held_out']} held-out images"
            io.write_image(plot, reliability_plot({"before": result.before, "after": result.after}, title))
        result.save(out)
    if as_json:
        typer.echo(json.dumps({"file": str(out), **result.to_json()}, indent=2))
    else:
        _print(result, out)


def _refuse_for_synthetic(root: Path | None, shape: tuple[int, int] | None) -> None:
    if root is not None:
        raise ValueError(f"synthetic scenes are made, not read: leave out --root, or name the --dataset of '{root}'")
    if shape is None:
        raise ValueError("synthetic scenes have no size of their own: give --size WIDTHxHEIGHT")


def _scene_options(texts: dict[str, str]) -> dict[str, Any]:
    """Text to the types of the scene's options; unknown ones stay text and are refused, with the nearest, later."""
    from ajna import synth

    known, options = synth.scene_options(), dict[str, Any](texts)
    if "mix" in texts:
        options["mix"] = _mix(texts["mix"])
    for name in texts.keys() & known.keys():
        kind = type(known[name])
        try:
            options[name] = kind(texts[name])
        except ValueError:
            raise ValueError(f"scene option '{name}' = '{texts[name]}': give a value of type {kind.__name__}") from None
    return options


def _mix(text: str) -> dict[str, float]:
    """general:4,gap:2 as presets with weights."""
    try:
        return {name: float(weight) for name, weight in (part.split(":") for part in text.split(","))}
    except ValueError:
        raise ValueError(
            f"scene option 'mix' = '{text}': give presets with weights, for example mix=general:4,gap:2"
        ) from None


def _levels(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"levels '{text}' are not numbers: give for example --levels 0.5,0.9") from None


def _grouping(pattern: str) -> Callable[[str], str]:
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise ValueError(f"--group '{pattern}' is not a regular expression ({error})") from None
    if compiled.groups < 1:
        raise ValueError(f"--group '{pattern}' has no group: put what images of one video share in (), as in '(.*)/'")

    def group_of(name: str) -> str:
        match = compiled.search(name)
        if match is None or match[1] is None:
            raise ValueError(f"--group '{pattern}' does not match image '{name}': give one that matches all names")
        return match[1]

    return group_of


# --- output --------------------------------------------------------------------------------------------------------


def _print(result: CalibrationResult, out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    images = result.images
    figures: dict[str, HeldOut] = {"before": result.before, "after": result.after}
    table = Table(title=f"{result.metadata.name} on {images['held_out']} held-out images", title_justify="left")
    table.add_column("", no_wrap=True)
    for name in figures:
        table.add_column(name, justify="right", no_wrap=True)

    def row(label: str, form: str, values: list[Any]) -> None:
        table.add_row(label, *(form.format(float(value)) for value in values))

    row("ECE of the expected error, px", "{:.3f}", [figure.reliability.ece for figure in figures.values()])
    row("relative (ENCE)", "{:.1%}", [figure.reliability.ence for figure in figures.values()])
    coverages = [figure.coverage for figure in figures.values()]
    for index, level in enumerate(result.after.coverage.levels.tolist()):
        row(f"coverage of the {level:.0%} interval", "{:.1%}", [coverage.coverage[index] for coverage in coverages])
        row("  its mean width, px", "{:.2f}", [coverage.width[index] for coverage in coverages])
    Console(width=None).print(table)
    typer.echo(f"intervals before: {result.before.intervals_from}; after: {result.after.intervals_from}")
    if result.skipped_levels:
        levels = ", ".join(f"{level:g}" for level in result.skipped_levels)
        typer.echo(f"no interval for {levels}: that takes more images than the {images['intervals']} of its part")
    for name, reason in result.bad.items():
        typer.echo(f"not used, because it cannot be read: {name}: {reason}")
    typer.echo(
        f"wrote {out}: expected error fitted on {images['expected_error']}, intervals on {images['intervals']} images"
    )
