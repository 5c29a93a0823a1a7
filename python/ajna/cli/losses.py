# SPDX-License-Identifier: MIT
"""``ajna losses``: the published losses, what they mean, and whether they are sound."""

from __future__ import annotations

import json
import sys
from typing import Any

import typer

from ajna.cli.options import JsonOption

_PIPED_WIDTH = 240  # columns, where there is no terminal to wrap for


def losses(as_json: JsonOption = False) -> None:
    """The rows of the paper's Table 3 as loss presets: terms, the expected error they mean, and their check.

    Example: ajna losses --json
    """
    records = _records()
    if as_json:
        typer.echo(json.dumps(records, indent=2))
    else:
        _print(records)


def _records() -> list[dict[str, Any]]:
    from ajna import _core
    from ajna.losses import presets

    records = []
    for preset in presets():
        config, loss = preset.config, _core.UncertaintyLoss(preset.config)
        report, likelihood = loss.check(), _core.Likelihood.of(loss)
        records.append(
            {
                "name": preset.name,
                "reference": preset.reference or None,
                "citation": preset.citation,
                "quantity": preset.quantity,
                "printed": {
                    "f": preset.printed_f,
                    "h": preset.printed_h,
                    "g": preset.printed_g,
                    "lam": preset.printed_lam,
                },
                "terms": {
                    **{role: _term(getattr(config, role)) for role in ("f", "h", "g", "parametrization")},
                    "lam": config.lam,
                },
                "kappa": preset.kappa,
                "likelihood": likelihood and {"name": likelihood.name, "factor": likelihood.factor},
                "normalised": likelihood is not None and likelihood.is_normalised,
                "check": {"admissible": report.admissible, "fails_at": report.fails_at, "reason": report.reason},
                "note": preset.note,
            }
        )
    return records


def _term(spec: Any) -> dict[str, Any]:
    return {"name": spec.name, "params": dict(spec.params)}


def _short(term: dict[str, Any]) -> str:
    params = ", ".join(f"{name}={value:g}" for name, value in term["params"].items())
    return f"{term['name']}({params})" if params else str(term["name"])


def _print(records: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH)
    table = Table(
        title="Losses of the paper's Table 3: E[h(a) f] + lam E[g(a)], kappa = -lam g'/h' = E[f] at the optimum"
    )
    for column in ("name", "ref", "f", "h", "g", "lam", "a(raw)", "kappa(a)", "likelihood", "check"):
        table.add_column(column, overflow="fold")
    for record in records:
        terms, likelihood = record["terms"], record["likelihood"]
        density = "-"
        if likelihood:
            density = (
                likelihood["name"] if record["normalised"] else f"{likelihood['factor']:.3g} x {likelihood['name']}"
            )
        check = record["check"]
        table.add_row(
            record["name"],
            str(record["reference"] or "-"),
            *(escape(_short(terms[role])) for role in ("f", "h", "g")),
            f"{terms['lam']:.4g}",
            escape(_short(terms["parametrization"])),
            escape(record["kappa"]),
            density,
            "admissible" if check["admissible"] else "[red]fails[/red]",
        )
    console.print(table)
    for record in records:
        reason = record["check"]["reason"]
        text = " ".join(part for part in (record["note"], reason and f"Check: {reason}.") if part)
        if text:
            console.print(f"[bold]{record['name']}[/bold]: {escape(text)}")
