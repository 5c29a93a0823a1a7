# SPDX-License-Identifier: MIT
"""The tables of all worlds in one section of a Markdown file, made anew from the trials in a folder."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ajna.baselines import Cost
from ajna.model import checkpoint_path
from ajna.sim.benchmark import EXPERIMENTS, Row, as_markdown, cost_of, rows_of
from ajna.sim.methods import METHODS
from ajna.sim.statistics import summarize
from ajna.sim.trials import stored_trials, write_json

__all__ = ["BEGIN", "END", "collect", "section", "write_report"]

BEGIN = "<!-- ajna bench report: begin; written by the command, edits between the marks are lost -->"
END = "<!-- ajna bench report: end -->"
_KEY = "simulation"  # of the record beside the page

_INTRODUCTION = """## Simulation: reference methods, and Ajna beside them

What flies and how it is measured stands in [simulation](simulation.md). Columns "paper" are the paper's figures, of
its own scenes and vehicle; columns "ours" are measured in the simulated worlds, with a 95 % bootstrap interval over the
trials (without width where all trials agree). A dash: not given, or does not apply. Ours are stand-ins in part: OccMask
and GapFlyt run on OpenCV's DIS flow, MorphEyes on semi-global matching, D435i is a model of the sensor. FLOPs and
parameters are a network's, at 320x240 (2 FLOPs per multiply-accumulate). Detection: an IoU of 0.5 or more with the true
mask, on the frame that was first acted on, and on that or any later one.

```sh
ajna bench WORLD --trials 50 --out flights      # for each world; goes on where it stopped
ajna bench report --out flights --markdown docs/results.md
```
"""

_OTHER_MODEL = (
    "A model's name behind the number of trials: they were flown with that one, `best` at the time, and not yet "
    "with the present one."
)


def collect(out: Path, earlier: dict[str, Any] | None = None) -> dict[str, list[Row]]:
    """The rows of every experiment, with a summary where trials lie in ``out``.

    Args:
        earlier: experiment -> rows as :meth:`ajna.sim.benchmark.Row.to_json` gives them; where ``out`` has no trials of
            a method, its summary there is kept; one of another shipped model than the present one says so.

    Raises:
        FileNotFoundError: there is no trial in ``out`` at all.
        ValueError: see :func:`ajna.sim.trials.stored_trials`.
    """
    tables: dict[str, list[Row]] = {}
    for experiment in EXPERIMENTS:
        tables[experiment] = rows_of(experiment)
        for row in tables[experiment]:
            results, flown = stored_trials(out, experiment, row.method)
            if results:
                row.measured = summarize(results)
                row.cost = cost_of(row.method)
                row.measured["seeds"] = [results[0].seed, results[-1].seed]
                row.measured["flown"] = {
                    key: sorted({one[key] for one in flown if key in one}) for key in ("date", "machine")
                }
                row.measured["model"] = _model_of(row.method)
    if not any(row.measured for rows in tables.values() for row in rows):
        raise FileNotFoundError(f"no trials of the present format in '{out}': fly some by ajna bench WORLD --out {out}")
    for experiment, rows in (earlier or {}).items():
        for row in tables.get(experiment, []):
            if row.measured is None:
                _keep(row, rows)
    return tables


def _model_of(method: str) -> str | None:
    """The shipped model that flies in a method; None for methods without it, and for networks of the user's."""
    return checkpoint_path("best").name if METHODS[method].takes_checkpoint else None


def _keep(row: Row, records: Any) -> None:
    """Take a row's summary and cost from a record of earlier ones, and the model's name where it is not the present."""
    for record in records if isinstance(records, list) else []:
        measured = record.get("measured") if isinstance(record, dict) and record.get("method") == row.method else None
        if isinstance(measured, dict):
            flew, present = measured.get("model"), _model_of(row.method)
            row.measured, row.cost = measured, cost_of(row.method)
            if flew != present:
                row.other_model = str(flew or "an unnamed model").removesuffix(".safetensors")
                row.cost = Cost(**record["cost"]) if isinstance(record.get("cost"), dict) else None


def section(tables: dict[str, list[Row]]) -> str:
    """The section between the marks, Markdown."""
    measured = [row.measured for rows in tables.values() for row in rows if row.measured is not None]
    dates = sorted({date for record in measured for date in record["flown"]["date"]})
    machines = sorted({machine for record in measured for machine in record["flown"]["machine"]})
    when = " to ".join(dict.fromkeys([dates[0], dates[-1]])) if dates else "unknown"
    parts = [_INTRODUCTION, f"Flown {when} on {'; '.join(machines) or 'an unknown machine'}."]
    if any(row.other_model for rows in tables.values() for row in rows):
        parts[1] += f" {_OTHER_MODEL}"
    for experiment, rows in tables.items():
        if any(row.measured for row in rows):
            parts.append(f"### {experiment}\n\n{as_markdown(experiment, rows)}\n\n{_endings(rows)}")
    parts.append(f"### Speed of the simulation\n\n{_speeds(tables)}")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _endings(rows: Sequence[Row]) -> str:
    """How trials ended, row by row."""
    lines = []
    for row in rows:
        if row.measured is not None:
            counts = ", ".join(f"{count} {reason}" for reason, count in row.measured["outcomes"].items())
            lines.append(f"{row.paper.title} {counts}")
    return "How trials ended: " + "; ".join(lines) + "."


def _speeds(tables: dict[str, list[Row]]) -> str:
    """Frames per second in one worker: methods down, worlds across."""
    columns = [name for name, rows in tables.items() if any(row.measured for row in rows)]
    methods: dict[str, dict[str, float]] = {}
    for name in columns:
        for row in tables[name]:
            if row.measured is not None and row.measured["frames_per_cpu_s"] is not None:
                methods.setdefault(row.paper.title, {})[name] = row.measured["frames_per_cpu_s"]
    lines = [
        "Frames per second of one core's time: pictures, physics, method and the judge of safe points together. With n "
        "workers on n free cores n times as many are flown each second.",
        "",
        "| method | " + " | ".join(columns) + " |",
        "|---|" + "---|" * len(columns),
    ]
    for title, rates in methods.items():
        lines.append(f"| {title} | " + " | ".join(f"{rates[c]:.1f}" if c in rates else "–" for c in columns) + " |")
    return "\n".join(lines)


def write_report(out: Path, page: Path, keep: bool = True) -> dict[str, list[Row]]:
    """Put the section into a page, between its marks or at its end, and the summaries into the JSON file beside it.

    What else stands in either file stays, and so do, with ``keep``, the rows of that JSON file whose trials do not lie
    in ``out`` any more (see :func:`collect`).

    Raises:
        FileNotFoundError, ValueError: see :func:`collect`; ValueError, too, where a mark is missing or out of order,
            or the JSON file does not hold a record.
    """
    record_path = page.with_suffix(".json")
    record = _record(record_path)
    earlier = record.get(_KEY) if keep else None
    tables = collect(out, earlier if isinstance(earlier, dict) else None)
    text = page.read_text(encoding="utf-8") if page.exists() else "# Results\n"
    changed = _replaced(text, section(tables), page)
    record[_KEY] = {name: [row.to_json() for row in rows if row.measured] for name, rows in tables.items()}
    page.parent.mkdir(parents=True, exist_ok=True)
    temporary = page.with_name(f".{page.name}.tmp")
    try:
        temporary.write_text(changed, encoding="utf-8")
        os.replace(temporary, page)
    finally:
        temporary.unlink(missing_ok=True)
    write_json(record_path, record)
    return tables


def _replaced(text: str, new: str, page: Path) -> str:
    block = f"{BEGIN}\n{new}{END}\n"
    counts = text.count(BEGIN), text.count(END)
    if counts == (0, 0):
        return f"{text.rstrip()}\n\n{block}"
    if counts != (1, 1) or text.index(BEGIN) > text.index(END):
        raise ValueError(f"'{page}' has the marks of ajna bench report not as one pair in order: mend or remove them")
    before, rest = text.split(BEGIN)
    return before + block + rest.split(END)[1].removeprefix("\n")


def _record(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"'{path}' is not JSON ({error}): mend or remove it") from error
    if not isinstance(record, dict):
        raise ValueError(f"'{path}' does not hold a record of results: mend or remove it")
    return record
