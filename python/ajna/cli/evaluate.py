# SPDX-License-Identifier: MIT
"""`ajna evaluate`: score models and classical methods on frame pairs with ground truth."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import DeviceOption, JsonOption, ThreadsOption, parse_size
from ajna.data.registry import DATASETS, open_dataset, parse_options

if TYPE_CHECKING:
    from rich.console import Console

    from ajna.baselines import FlowMethod
    from ajna.calibration import HeldOut
    from ajna.data.frame_pair import FramePair
    from ajna.evaluation import Evaluation, MethodReport, Scores


# field of Scores -> (heading, format); fractions are shown in percent
_COLUMNS = {
    "epe": ("EPE", "{:.2f}"),
    "zero_epe": ("zero", "{:.2f}"),
    "ratio": ("ratio", "{:.1%}"),
    "fl_all": ("Fl-all", "{:.1%}"),
    "ause": ("AUSE", "{:.3f}"),
    "rho": ("rho", "{:.2f}"),
    "occlusion_auc": ("AUC", "{:.2f}"),
    "motion_boundary_auc": ("edges", "{:.2f}"),
    "expected_boundary_ratio": ("times", "{:.1f}"),
    "error_boundary_ratio": ("true", "{:.1f}"),
    "run_time_ms": ("ms", "{:.1f}"),
}

_PIPED_WIDTH = 120  # columns, where there is no terminal to ask

_LEGEND = (
    "EPE: mean end-point error per image, px at the scored size; zero: that of zero flow; ratio: EPE / zero. "
    "Fl-all: pixels off by over 3 px and 5 %. "
    "AUSE: mean EPE of the kept pixels over the full mean, 50 bins, per image, area to the oracle. "
    "rho: Spearman correlation of uncertainty and error. AUC: ROC AUC of the uncertainty for occlusion; "
    "edges: for motion boundaries; times: median expected error there and where hidden over that of textured surfaces; "
    "true: the same of the error itself. "
    "ms: median time of flow and uncertainty."
)


def evaluate(
    root: Annotated[Path, typer.Option(help="Folder of the data set; for 'pairs' one folder per pair.")],
    dataset: Annotated[str, typer.Option(metavar="NAME", help=f"Kind of data set: {', '.join(DATASETS)}.")] = "pairs",
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the data set, e.g. pass_name=final; repeatable."),
    ] = None,
    skip_bad: Annotated[bool, typer.Option(help="Count and list unreadable pairs instead of stopping.")] = False,
    model: Annotated[
        list[str] | None, typer.Option(help="Model by name, checkpoint or TorchScript file; may be repeated.")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="Classical method: dis, farneback, zero or all (of these); or, from the first --model, "
            "forward_backward, mc_dropout, mc_dropout_mixture, and from all of them ensemble, ensemble_mixture; "
            "may be repeated, also beside --model."
        ),
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="Each model once more on pairs without the motion of their largest plane.")
    ] = False,
    size: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT at which all is run and scored, or 'full' for each pair's own.")
    ] = "320x240",
    cases: Annotated[list[str] | None, typer.Option(help="Only this case; may be repeated or comma-separated.")] = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option(help="Also print the mean without this case; may be repeated or comma-separated."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs per case.")] = 3,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for evaluation.json, an overview picture per case, sparsification.png.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score flow and uncertainty against ground truth.

    Example: ajna evaluate --root data/pairs --model best --method dis --out out/evaluation

    A case named sintel_market5_final_0002 (motion up to 132 px) counts for uncertainty only, not in the mean EPE.
    """
    from rich.console import Console

    from ajna.cli.outputs import check_folder, staged_folder
    from ajna.evaluation import evaluate as run

    scored_size = None if size == "full" else parse_size(size)
    if out is not None:
        check_folder(out)
    data = open_dataset(dataset, root, _split(cases), skip_bad, parse_options(option), scoring=True)
    methods = _methods(model or [], _split(method), device, threads, align)
    total, done = len(data) * len(methods), 0
    with (
        staged_folder(out) if out is not None else nullcontext() as stage,
        Console(stderr=True).status("starting") as status,
    ):

        def on_case(name: str, pair: FramePair, field: Any, scores: Scores) -> None:
            nonlocal done
            done += 1
            status.update(f"{done} of {total}: {name} on {pair.name}")
            if stage is not None:
                _write_overview(stage / f"{_file_name(name)}_{_file_name(pair.name)}.png", name, pair, field)

        result = run(data, methods, size=scored_size, exclude=_split(exclude), repeats=repeats, on_case=on_case)
        record = {"dataset": dataset, "root": str(root), **result.to_json()}
        if stage is not None:
            _write_results(stage, record, result)
    if as_json:
        typer.echo(json.dumps(record, indent=2))
        return
    screen = Console()
    print_tables(result, screen if screen.is_terminal else Console(width=_PIPED_WIDTH), root)
    if out is not None:
        typer.echo(f"wrote evaluation.json, sparsification.png and {total} overview pictures to {out}")


def _split(values: Iterable[str] | None) -> list[str]:
    return [part for value in values or () for part in value.split(",") if part]


def _methods(
    models: list[str], baselines: list[str], device: str, threads: int | None, align: bool
) -> dict[str, FlowMethod]:
    """Name -> method, models first; the shipped model if nothing is asked for."""
    import ajna
    from ajna.baselines import BASELINES, SAMPLED, SamplingOptions, make_baseline, make_sampled, with_aligned

    if "all" in baselines:
        baselines = list(dict.fromkeys([name for name in baselines if name != "all"] + list(BASELINES)))
    if not models and (not baselines or any(name in SAMPLED for name in baselines)):
        models = ["best"]
    methods: dict[str, FlowMethod] = {}
    for model in models:
        name = Path(model).name if Path(model).suffix else model
        if name in methods:
            raise ValueError(f"two models are named '{name}' ({', '.join(models)}); rename one of the files.")
        methods[name] = ajna.load(model, device=device, threads=threads)
    loaded: list[Any] = list(methods.values())
    if align:
        methods = with_aligned(methods)
    for name in baselines:
        if name in SAMPLED:
            methods[name] = make_sampled(name, loaded[0], loaded, SamplingOptions(device=device))
        else:
            methods[name] = make_baseline(name, also=SAMPLED)
    return methods


# --- output --------------------------------------------------------------------------------------------------------


def print_tables(result: Evaluation, console: Console, root: Path) -> None:
    """One table per method and, where there are several, their means side by side."""
    from rich.table import Table

    size = "each pair's own size" if result.size is None else f"{result.size[0]}x{result.size[1]}"

    def table(title: str, first: str) -> Table:
        made = Table(title=title, title_justify="left")
        made.add_column(first, no_wrap=True)
        for heading, _ in _COLUMNS.values():
            made.add_column(heading, justify="right", no_wrap=True)
        return made

    for name, report in result.methods.items():
        rows = table(f"{name} on {root}, at {size}", "case")
        for case, scores in report.cases.items():
            rows.add_row(case + (" *" if case in result.uncertainty_only else ""), *_cells(scores))
        rows.add_section()
        for label, scores in _means(report):
            rows.add_row(label, *_cells(scores), style="bold")
        console.print(rows)
    if len(result.methods) > 1:
        rows = table("means side by side", "method")
        for name, report in result.methods.items():
            for label, scores in _means(report):
                rows.add_row(name if label == "mean" else f"{name}, {label}", *_cells(scores))
        console.print(rows)
    if result.uncertainty_only:
        console.print(
            f"* {', '.join(result.uncertainty_only)}: extreme motion, for judging uncertainty only; "
            "the means of EPE, zero flow, their ratio, Fl-all and other figures in pixels leave it out."
        )
    for name, report in result.methods.items():
        if report.calibration is not None:
            console.print(f"{name}: {_calibration_line(report.calibration)}")
    for name, report in result.methods.items():
        if (line := _pooled_line(report.mean)) is not None:
            console.print(f"{name}: {line}")
    if result.excluded:
        console.print(f"excluded: {', '.join(result.excluded)}")
    if result.bad:
        console.print(f"not scored, because they cannot be read: {len(result.bad)}")
        for case, reason in result.bad.items():
            console.print(f"  {case}: {reason}", soft_wrap=True)
    console.print(_LEGEND, style="dim")


def _means(report: MethodReport) -> list[tuple[str, Scores]]:
    rows = [("mean", report.mean)]
    if report.mean_without_excluded is not None:
        rows.append(("mean without excluded", report.mean_without_excluded))
    return rows


def _calibration_line(figures: HeldOut) -> str:
    curve = figures.coverage
    shares = zip(curve.levels.tolist(), curve.coverage.tolist(), curve.width.tolist(), strict=True)
    intervals = "; ".join(f"{level:.0%}: {share:.1%}, {width:.1f} px" for level, share, width in shares)
    return f"expected error off by {figures.reliability.ece.item():.2f} px (ECE); intervals hold, are wide: {intervals}"


def _pooled_line(mean: Scores) -> str | None:
    if mean.pooled_boundary_ratio is None:
        return None
    error = mean.pooled_error_boundary_ratio
    true = "" if error is None else f" (the true error {error:.1f} times)"
    times = f"{mean.pooled_boundary_ratio:.1f} times that of textured surfaces"
    return f"expected error at boundaries and where hidden {times}{true}, over the pixels of all cases"


def _cells(scores: Scores) -> list[str]:
    values = ((getattr(scores, name), form) for name, (_, form) in _COLUMNS.items())
    return ["–" if value is None else form.format(value) for value, form in values]


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]", "_", name)


def _write_overview(path: Path, method: str, pair: FramePair, field: Any) -> None:
    import numpy as np

    from ajna import io, viz
    from ajna.baselines import BaselineField

    truth = None if pair.flow is None or pair.valid is None else np.where(pair.valid[..., None], pair.flow, np.nan)
    label = field.label if isinstance(field, BaselineField) else "expected error"
    picture = viz.overview(pair.frame1, pair.frame2, field, truth, title=f"{pair.name}: {method}", error_label=label)
    io.write_image(path, picture)


def _write_results(folder: Path, record: dict[str, Any], result: Evaluation) -> None:
    from ajna import io, viz

    curves = {
        name: viz.Curve(report.curves.by_uncertainty.numpy(), report.curves.oracle.numpy(), report.curves.ause.item())
        for name, report in result.methods.items()
        if report.curves is not None
    }
    io.write_image(
        folder / "sparsification.png", viz.sparsification_plot(curves, "Sparsification, mean over the pairs")
    )
    calibrated = {name: report.calibration for name, report in result.methods.items() if report.calibration is not None}
    if calibrated:
        from ajna.calibration import reliability_plot

        io.write_image(folder / "reliability.png", reliability_plot(calibrated, "Calibration over all pairs"))
    (folder / "evaluation.json").write_text(json.dumps(record, indent=2))
