# SPDX-License-Identifier: MIT
"""``ajna bench``: comparisons that print a table of what was measured here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import DeviceOption, JsonOption, ModelOption, ThreadsOption, parse_size
from ajna.data.registry import DATASETS

if TYPE_CHECKING:
    from ajna.baselines import SamplingOptions
    from ajna.data.dataset import FlowDataset

SYNTHETIC = "synthetic"
MEMBER_FILE = "model.safetensors"  # what a training run leaves in its folder

bench = typer.Typer(
    help="Measure and compare; each command prints a table.",
    epilog="Example: ajna bench uncertainty --dataset synthetic",
    no_args_is_help=True,
)


@bench.callback()
def _group() -> None:
    """Keeps `ajna bench NAME` a group while it holds one command."""


@bench.command()
def uncertainty(
    dataset: Annotated[
        str, typer.Option(metavar="NAME", help=f"Kind of data set: {SYNTHETIC}, {', '.join(DATASETS)}.")
    ] = SYNTHETIC,
    root: Annotated[Path | None, typer.Option(help=f"Folder of the data set; none for '{SYNTHETIC}'.")] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the data set, e.g. pass_name=final; repeatable."),
    ] = None,
    scenes: Annotated[int, typer.Option(min=1, help=f"Number of scenes of '{SYNTHETIC}'.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes and of the dropout masks.")] = 0,
    cases: Annotated[list[str] | None, typer.Option(help="Only this case; may be repeated or comma-separated.")] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(help="Leave this case out of the means; may be repeated or comma-separated.")
    ] = None,
    model: ModelOption = "best",
    member: Annotated[
        list[str] | None, typer.Option(help="A network of the ensemble, by name or file; give two or more.")
    ] = None,
    members_from: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help=f"Folder of training runs: every DIR/*/{MEMBER_FILE} is a member."),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="Only these beside the one pass: mc_dropout, mc_dropout_mixture, ensemble, ensemble_mixture, "
            "forward_backward, dis, farneback; may be repeated or comma-separated."
        ),
    ] = None,
    rate: Annotated[float, typer.Option(help="Share of channels that MC dropout drops.")] = 0.1,
    passes: Annotated[int, typer.Option(help="Passes of MC dropout.")] = 8,
    layer: Annotated[
        list[str] | None,
        typer.Option(help="Layer whose output MC dropout drops, e.g. encoder.5; repeatable. Default: the narrowest."),
    ] = None,
    mixture: Annotated[
        str, typer.Option(help="Noise that the mixture rows assume around each flow: laplace or gaussian.")
    ] = "laplace",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT at which all is run and scored.")] = "320x240",
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs per pair and method.")] = 3,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    out: Annotated[Path | None, typer.Option(help="Folder for uncertainty.md and uncertainty.json.")] = None,
    as_json: JsonOption = False,
) -> None:
    """One pass beside MC dropout, deep ensembles and forward-backward consistency: time and quality.

    Example: ajna bench uncertainty --dataset synthetic --members-from runs --out out/bench

    Prints a Markdown table. Ensemble rows need members, for which train one network from each of several seeds:
    python train/train.py fit --config CONFIG --name member1 --seed_everything 1 --data.seed 1, and so on.
    """
    from contextlib import nullcontext

    from rich.console import Console

    import ajna
    from ajna.baselines import SamplingOptions
    from ajna.benchmarks.uncertainty import compare
    from ajna.cli.outputs import check_folder, print_report, staged_folder, write_report

    scored_size = parse_size(size)
    assert scored_size is not None
    if out is not None:
        check_folder(out)
    data = _open(dataset, root, split(cases), option, scenes, seed, scored_size)
    member_files = find_members(member or [], members_from)
    layers = tuple(layer) if layer else None
    options = SamplingOptions(rate, passes, layers, seed, mixture, device)
    _check(options)
    if threads is not None:
        _set_opencv_threads(threads)
    one_pass = ajna.load(model, device=device, threads=threads)
    members = [ajna.load(file, device=device, threads=threads) for file in member_files]
    done = 0
    with (
        staged_folder(out) if out is not None else nullcontext() as stage,
        Console(stderr=True).status("starting") as status,
    ):

        def on_case(name: str, pair: Any, field: Any, scores: Any) -> None:
            nonlocal done
            done += 1
            status.update(f"{name} on {pair.name} ({done} done)")

        table = compare(
            data,
            one_pass,
            dataset_name=dataset if root is None else f"{dataset} in {root.name}",
            members=members,
            methods=split(method) or None,
            options=options,
            size=scored_size,
            repeats=repeats,
            exclude=split(exclude),
            on_case=on_case,
        )
        write_report(table, "uncertainty", stage)
    print_report(table, as_json)


def split(values: Iterable[str] | None) -> list[str]:
    """['a,b', 'c'] -> ['a', 'b', 'c']."""
    return [part for value in values or () for part in value.split(",") if part]


def find_members(named: Sequence[str], folder: Path | None) -> list[str]:
    """The files or names of an ensemble's members: those named, then every DIR/*/model.safetensors by name.

    Raises:
        FileNotFoundError: no such folder, or no run in it.
        ValueError: `folder` is a run itself, or one member alone.
    """
    members = list(named)
    if folder is not None:
        if not folder.is_dir():
            raise FileNotFoundError(f"folder of runs '{folder}' does not exist; give the folder that holds the runs.")
        if (folder / MEMBER_FILE).is_file():
            raise ValueError(f"'{folder}' is one run, hence one member; give the folder that holds the runs.")
        found = sorted(folder.glob(f"*/{MEMBER_FILE}"))
        if not found:
            raise FileNotFoundError(f"'{folder}' holds no runs: expected {folder}/RUN/{MEMBER_FILE}.")
        members += [str(path) for path in found]
    if len(members) == 1:
        raise ValueError(f"'{members[0]}' alone is no ensemble; give two members or more, or none.")
    return members


def _check(options: SamplingOptions) -> None:
    """What a method would refuse later, in time: before any network is loaded or pair is run."""
    from ajna.baselines.sampled import check_mixture, check_sampling

    check_mixture(options.mixture)
    check_sampling(options.rate, options.passes)


def _open(
    name: str,
    root: Path | None,
    cases: list[str],
    assignments: list[str] | None,
    scenes: int,
    seed: int,
    size: tuple[int, int],
) -> FlowDataset:
    from ajna.data.registry import open_dataset, parse_options
    from ajna.data.synthetic import SyntheticScenes

    if name == SYNTHETIC:
        if root is not None or cases or assignments:
            raise ValueError(f"data set '{SYNTHETIC}' is generated: it takes no --root, --cases or --set.")
        return SyntheticScenes(scenes, *size, seed=seed)
    if root is None:
        raise ValueError(f"data set '{name}' lies in a folder: give --root DIR, or --dataset {SYNTHETIC}.")
    return open_dataset(name, root, cases, False, parse_options(assignments), scoring=True)


def _set_opencv_threads(threads: int) -> None:
    """The classical methods, too, get the threads that were asked for."""
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(threads)
