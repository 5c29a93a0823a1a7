# SPDX-License-Identifier: MIT
"""The tables of `ajna bench speed` in Markdown."""

from __future__ import annotations

from ajna.benchmarks.speed import PAPER_HARDWARE, Row, Speed

_HEADINGS = (
    "format",
    "ms, p50",
    "p95",
    "p99",
    "pairs/s",
    "GFLOP/s",
    "share of matrix rate",
    "peak memory, MB",
    "file, MB",
    "max abs difference, raw",
    "same, flow px",
    "runs",
)
_PAPER_HEADINGS = ("platform", "ms", "pairs/s", "from")


def markdown(speed: Speed) -> str:
    """Both tables and what they were measured with."""
    width, height = speed.size
    machine, model = speed.machine, speed.model
    versions = ", ".join(f"{name} {version}" for name, version in speed.versions.items())
    nice = f", nice {speed.nice}" if speed.nice else ""
    lines = [
        *_table(_HEADINGS, [_cells(row) for row in speed.rows]),
        "",
        f"- Network: {speed.parameters:,} parameters, {speed.flops / 1e9:.2f} GFLOP a pair (2 per multiply-add) at "
        f"{width}x{height}; the paper states 2.72 million and 6.3.",
        f"- Matrix rate: {speed.matrix_flops_per_s / 1e9:.1f} GFLOP/s, the median float32 product of two "
        f"{speed.matrix_side}x{speed.matrix_side} matrices by torch, "
        "measured between the formats with as many threads.",
        "- Times are from two uint8 frames in memory to flow, uncertainty and expected error in memory, one pair at a "
        f"time, {speed.threads} threads; each format in {speed.rounds} processes of its own, in turns of "
        f"{speed.seconds:g} s. Peak memory is the largest resident set of such a process, runtime included.",
        f"- Model: {model['file']}, SHA-256 {model['sha256'][:16]}.",
        f"- Machine: {machine['cpu']} ({machine['capability']}), {machine['cores']} cores; load average "
        f"{machine['load_average']:g} at the start, {speed.load_average_after:g} at the end{nice}.",
        f"- Versions: {versions}.",
        *(f"- {row.label}: {row.note}." for row in speed.rows if row.note is not None and row.missing is None),
        *(f"- {note}" for note in speed.notes),
        "",
        "The paper's hardware, with this machine:",
        "",
        *_table(_PAPER_HEADINGS, _hardware(speed)),
    ]
    return "\n".join(lines) + "\n"


def _hardware(speed: Speed) -> list[list[str]]:
    rows = [[name, f"{ms:.1f}", f"{1000 / ms:.1f}", "paper"] for name, ms in PAPER_HARDWARE]
    this = f"this machine ({speed.machine['cpu']}, {speed.threads} threads)"
    for row in speed.rows:
        if row.p50_ms is not None:
            rows.append([f"{this}, {_name(row)}", f"{row.p50_ms:.1f}", f"{1000 / row.p50_ms:.1f}", "here"])
    return rows


def _name(row: Row) -> str:
    return row.label + (" (emulated)" if (row.note or "").startswith("emulated") else "")


def _cells(row: Row) -> list[str]:
    if row.missing is not None or row.p50_ms is None:
        return [row.label, f"*{row.missing}*", *["–"] * (len(_HEADINGS) - 2)]

    def text(value: float | None, form: str, scale: float = 1.0) -> str:
        return "–" if value is None else format(value / scale, form)

    return [
        _name(row),
        text(row.p50_ms, ".1f"),
        text(row.p95_ms, ".1f"),
        text(row.p99_ms, ".1f"),
        text(1000 / row.p50_ms, ".1f"),
        text(row.flops_per_s, ".1f", 1e9),
        text(row.share_of_matrix_product, ".0%"),
        text(row.peak_bytes, ".0f", 1e6),
        text(row.file_bytes, ".1f", 1e6),
        text(row.max_abs_difference, ".1e"),
        text(row.flow_difference_px, ".1e"),
        text(row.runs, ".0f"),
    ]


def _table(headings: tuple[str, ...], rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(headings) + " |", "|---" * len(headings) + "|"]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]
