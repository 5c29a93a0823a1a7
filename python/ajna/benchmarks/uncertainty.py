# SPDX-License-Identifier: MIT
"""What one pass buys: the model's own uncertainty beside the alternatives, time and quality in one table.

Every method is run and scored by `ajna.evaluation` on the same pairs at the same size, all methods on one pair before
the next, so that a machine that becomes busy slows all of them. Times are of whole answers, from two uint8 frames to
flow *and* uncertainty; the ratio is that of the medians to the model's one pass in the same run.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ajna.baselines import SAMPLED, Cost, CostedMethod, OnePass, SamplingOptions, make_baseline, make_sampled
from ajna.benchmarks.machine import describe_machine, describe_versions
from ajna.data.dataset import FlowDataset
from ajna.evaluation import Evaluation, MethodReport, OnCase, evaluate
from ajna.model import Model

ONE_PASS = "one_pass"
LABELS = {
    ONE_PASS: "this model, one pass",
    **SAMPLED,
    "dis": "forward-backward of DIS flow",
    "farneback": "forward-backward of Farneback flow",
}
NO_WEIGHTS = "weights not given"

_NOTES = {
    "mc_dropout": "MC dropout: channels of {layers} dropped at rate {rate:g} in a network trained without dropout.",
    "mixture": "Mixture: variance over the passes plus what each pass claims by its expected error ({mixture} noise).",
    "ensemble": "Deep ensemble: {members} networks of the same shape, trained from different seeds.",
}

_HEADINGS = (
    "method",
    "passes",
    "parameters",
    "GFLOP",
    "ms, median",
    "ms, p90",
    "time / one pass",
    "EPE px",
    "AUSE",
    "rho",
    "AUC",
)
_LEGEND = (
    "AUSE: area between the sparsification curve (mean EPE of the kept pixels over the full mean, 50 bins, per image) "
    "and its oracle, less is better. rho: Spearman correlation of uncertainty and error. AUC: ROC AUC of the "
    "uncertainty for occlusion. Means over the pairs that have the figure."
)


@dataclass(frozen=True)
class Row:
    """One method. Figures are None where they are not measured (`missing` says why) or not defined."""

    name: str
    label: str
    missing: str | None = None
    passes: int | None = None
    parameters: int | None = None
    flops: int | None = None
    run_time_ms: float | None = None  # median
    run_time_p90_ms: float | None = None
    run_time_ratio: float | None = None  # median over the median of one pass
    epe: float | None = None
    ause: float | None = None
    rho: float | None = None
    occlusion_auc: float | None = None


@dataclass(frozen=True)
class Comparison:
    """The table and what it depends on."""

    rows: tuple[Row, ...]
    dataset: str
    cases: int
    size: tuple[int, int]  # (width, height)
    repeats: int
    model: dict[str, str]  # name, file, sha256
    members: tuple[dict[str, str], ...]
    options: SamplingOptions
    machine: dict[str, Any]
    versions: dict[str, str]
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain keys, numbers, null where there is none."""
        return asdict(self)

    def to_markdown(self) -> str:
        """The table, and below it what it was measured with."""
        width, height = self.size
        machine, model = self.machine, self.model
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        lines = [
            "| " + " | ".join(_HEADINGS) + " |",
            "|---" * len(_HEADINGS) + "|",
            *(_markdown_row(row) for row in self.rows),
            "",
            f"- Data: {self.dataset}, {self.cases} pairs, run and scored at {width}x{height}; "
            f"{self.repeats} timed calls a pair.",
            f"- Model: {model['file']}, SHA-256 {model['sha256'][:16]}.",
            *(f"- Member: {member['file']}, SHA-256 {member['sha256'][:16]}." for member in self.members),
            f"- Machine: {machine['cpu']} ({machine['capability']}), {machine['cores']} cores, "
            f"{machine['threads']} threads, load average {machine['load_average']:g} at the start; "
            f"{', '.join(machine['cuda']) or 'no GPU'}.",
            f"- Versions: {versions}.",
            *(f"- {note}" for note in self.notes),
            f"- {_LEGEND}",
        ]
        return "\n".join(lines) + "\n"


def compare(
    dataset: FlowDataset,
    model: Model,
    *,
    dataset_name: str,
    members: Sequence[Model] = (),
    methods: Iterable[str] | None = None,
    options: SamplingOptions | None = None,
    size: tuple[int, int] = (320, 240),
    repeats: int = 3,
    exclude: Iterable[str] = (),
    on_case: OnCase | None = None,
) -> Comparison:
    """Measure the model's one pass and every method of `methods` on every pair.

    Args:
        dataset_name: how the table calls the data.
        members: the networks of the ensemble rows; without them those rows say that weights were not given.
        methods: keys of `LABELS`; by default all, of which those whose software or file is not there become rows that
            say so. One pass is always measured.
        options: of the sampled methods.
        size: (width, height) at which all is run and scored.
        repeats: timed calls per pair and method, after one that is not timed.
        exclude: cases that stay out of the means.
        on_case: see `ajna.evaluation.evaluate`.

    Raises:
        ValueError: an unknown method, or an option that a method refuses.
        RuntimeError: a method that was asked for by name cannot run here.
    """
    chosen = options or SamplingOptions()
    names = _check_methods(methods)
    machine = describe_machine()  # before the load average counts this run
    ready, missing = _make_methods(names, model, members, chosen, strict=methods is not None)
    excluded = tuple(exclude)
    result = evaluate(dataset, ready, size=size, exclude=excluded, repeats=repeats, on_case=on_case)
    return Comparison(
        rows=_rows(names, result, {name: method.cost(*size) for name, method in ready.items()}, missing),
        dataset=dataset_name,
        cases=len(dataset) - len(dataset.bad) - len(excluded),
        size=size,
        repeats=repeats,
        model=_identity(model),
        members=tuple(_identity(member) for member in members),
        options=chosen,
        machine=machine,
        versions=describe_versions(),
        notes=_notes(ready, members, chosen),
    )


def _check_methods(methods: Iterable[str] | None) -> list[str]:
    from ajna._core import nearest_name

    names = list(dict.fromkeys(methods)) if methods is not None else list(LABELS)
    for name in names:
        if name not in LABELS:
            near = nearest_name(name, list(LABELS))
            hint = f"did you mean '{near}'?" if near else f"known are {', '.join(LABELS)}."
            raise ValueError(f"unknown method '{name}' to compare; {hint}")
    return [ONE_PASS, *(name for name in names if name != ONE_PASS)]


def _make_methods(
    names: Sequence[str], model: Model, members: Sequence[Model], options: SamplingOptions, strict: bool
) -> tuple[dict[str, CostedMethod], dict[str, str]]:
    """The methods that can run, and why the others cannot. Without weights an ensemble is a row even when asked for."""
    ready: dict[str, CostedMethod] = {}
    missing: dict[str, str] = {}
    for name in names:
        if name == ONE_PASS:
            ready[name] = OnePass(model)
        elif name.startswith("ensemble") and not members:
            missing[name] = NO_WEIGHTS
        elif name in SAMPLED:
            if name.startswith("mc_dropout") and not strict and not model.info.path.endswith(".safetensors"):
                missing[name] = "needs a checkpoint"
                continue
            ready[name] = make_sampled(name, model, members, options)
        else:
            try:
                ready[name] = make_baseline(name)
            except RuntimeError:
                if strict:
                    raise
                missing[name] = "needs OpenCV's Python package"
    return ready, missing


def _rows(
    names: Sequence[str], result: Evaluation, costs: Mapping[str, Cost], missing: Mapping[str, str]
) -> tuple[Row, ...]:
    reference = statistics.median(result.methods[ONE_PASS].run_times_ms)
    return tuple(
        Row(name, LABELS[name], missing=missing[name])
        if name in missing
        else _row(name, result.methods[name], costs[name], reference)
        for name in names
    )


def _row(name: str, report: MethodReport, cost: Cost, reference_ms: float) -> Row:
    scores = report.mean_without_excluded or report.mean
    median = statistics.median(report.run_times_ms)
    return Row(
        name,
        LABELS[name],
        None,
        *cost,
        run_time_ms=median,
        run_time_p90_ms=percentile(report.run_times_ms, 90),
        run_time_ratio=median / reference_ms,
        epe=scores.epe,
        ause=scores.ause,
        rho=scores.rho,
        occlusion_auc=scores.occlusion_auc,
    )


def percentile(values: Sequence[float], percent: int) -> float:
    """Linear interpolation between order statistics, as numpy's default."""
    if len(values) == 1:
        return values[0]
    return statistics.quantiles(values, n=100, method="inclusive")[percent - 1]


def _identity(model: Model) -> dict[str, str]:
    return {"name": model.info.name, "file": Path(model.info.path).name, "sha256": model.sha256}


def _notes(ready: Mapping[str, CostedMethod], members: Sequence[Model], options: SamplingOptions) -> tuple[str, ...]:
    from ajna.baselines import McDropout

    notes = []
    dropout = next((method for method in ready.values() if isinstance(method, McDropout)), None)
    if dropout is not None:
        notes.append(_NOTES["mc_dropout"].format(layers=", ".join(dropout.layers), rate=dropout.rate))
    if any(name.startswith("ensemble") for name in ready):
        notes.append(_NOTES["ensemble"].format(members=len(members)))
    if any(name.endswith("_mixture") for name in ready):
        notes.append(_NOTES["mixture"].format(mixture=options.mixture.capitalize()))
    return tuple(notes)


def _markdown_row(row: Row) -> str:
    if row.missing is not None:
        return f"| {row.label} | *{row.missing}* |" + " – |" * (len(_HEADINGS) - 2)

    def text(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    cells = (
        text(row.passes, "d"),
        text(row.parameters, ",d"),
        text(None if row.flops is None else row.flops / 1e9, ".2f"),
        text(row.run_time_ms, ".1f"),
        text(row.run_time_p90_ms, ".1f"),
        text(row.run_time_ratio, ".2f"),
        text(row.epe, ".2f"),
        text(row.ause, ".3f"),
        text(row.rho, ".2f"),
        text(row.occlusion_auc, ".2f"),
    )
    return f"| {row.label} | " + " | ".join(cells) + " |"
