# SPDX-License-Identifier: MIT
"""Logs of the flight program (``ajna_flight``): read back, summed up, drawn.

A log is one JSON object a line (docs/flight.md). The last line of a flight that ended badly may be cut, and a full disk
leaves gaps: such lines are skipped and counted, never guessed at.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ajna.plots import _figure, _grid, _rgb

__all__ = ["FlightRecord", "frame_pictures", "overview", "read_log"]

RgbImage = NDArray[np.uint8]
Floats = NDArray[np.float64]
Row = dict[str, Any]

_KINDS = ("start", "frame", "state", "event", "end")
_STATE_COLORS = {"standby": "0.9", "active": "#8fd48f", "releasing": "#f0a0a0"}
_HEAD_PX = 40
_MIN_WIDTH_PX = 480


@dataclass
class FlightRecord:
    """What a log says, by kind of line and in order; times are seconds since the flight's start."""

    path: Path
    start: Row = field(default_factory=dict)
    end: Row = field(default_factory=dict)
    frames: list[Row] = field(default_factory=list)
    states: list[Row] = field(default_factory=list)
    events: list[Row] = field(default_factory=list)
    skipped_lines: int = 0

    def column(self, rows: Sequence[Row], key: str) -> Floats:
        """A number of each row; NaN where it is missing or null."""
        return np.array([row[key] if isinstance(row.get(key), int | float) else np.nan for row in rows], dtype=float)

    def vectors(self, rows: Sequence[Row], key: str, size: int) -> Floats:
        """A list of each row, [len(rows), size]; NaN where it is missing or of another length."""
        lists = [row.get(key) for row in rows]
        nothing = [np.nan] * size
        fits = [v if isinstance(v, list) and len(v) == size else nothing for v in lists]
        return np.array(fits, dtype=float).reshape(len(rows), size)

    @property
    def releases(self) -> list[Row]:
        return [event for event in self.events if str(event.get("text", "")).startswith("released")]

    def summary(self) -> dict[str, Any]:
        """The flight in a few numbers; latencies in milliseconds, from capture until perception had its command."""
        latency = self.column(self.frames, "latency_ms")
        latency = latency[np.isfinite(latency)]
        states = [row.get("state") for row in self.states]
        times = self.column(self.states, "time_s")
        steps = np.diff(times, append=times[-1:])
        active = float(sum(step for step, state in zip(steps, states, strict=True) if state == "active" and step < 1.0))
        return {
            "duration_s": float(times[-1]) if len(times) else 0.0,
            "active_s": active,
            "frames": len(self.frames),
            "releases": len(self.releases),
            "latency_p50_ms": float(np.quantile(latency, 0.5)) if latency.size else None,
            "latency_p95_ms": float(np.quantile(latency, 0.95)) if latency.size else None,
            "latency_p99_ms": float(np.quantile(latency, 0.99)) if latency.size else None,
            "ended": bool(self.end),
            "skipped_lines": self.skipped_lines,
        }


def read_log(path: str | Path) -> FlightRecord:
    """The log at ``path``.

    Raises:
        FileNotFoundError: where it is missing; ValueError for a file that is no log of a flight.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"file '{path}' does not exist: give a log of ajna_flight (flight-0001.jsonl)")
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder: give one of the .jsonl files in it")
    record = FlightRecord(path)
    for line in path.read_bytes().splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            record.skipped_lines += 1
            continue
        kind = row.get("type") if isinstance(row, dict) else None
        if kind not in _KINDS or (kind not in ("start", "end") and not isinstance(row.get("time_s"), int | float)):
            record.skipped_lines += 1
        elif kind == "start":
            record.start = row
        elif kind == "end":
            record.end = row
        else:
            {"frame": record.frames, "state": record.states, "event": record.events}[kind].append(row)
    if not record.start:
        raise ValueError(f"'{path}' is no log of ajna_flight: its first line must be the flight's start")
    if not record.states:
        raise ValueError(f"log '{path}' ends before the flight began: nothing to draw")
    return record


# --- plots ---------------------------------------------------------------------------------------------------------


def _shade(place: Axes, record: FlightRecord) -> None:
    """The state of the safety machine behind a plot over time."""
    times = record.column(record.states, "time_s")
    states = [str(row.get("state")) for row in record.states]
    begin = 0
    for i in range(1, len(states) + 1):
        if i == len(states) or states[i] != states[begin]:
            last = times[min(i, len(states) - 1)]
            place.axvspan(times[begin], last, color=_STATE_COLORS.get(states[begin], "0.9"), alpha=0.5, lw=0)
            begin = i


def _mark_releases(place: Axes, record: FlightRecord) -> None:
    for event in record.releases:
        text = str(event["text"])
        reason = text[text.find("(") + 1 : text.find(")")] if "(" in text else text
        place.axvline(event["time_s"], color="C3", lw=1)
        place.annotate(
            reason,
            (event["time_s"], 0.97),
            xycoords=("data", "axes fraction"),
            rotation=90,
            va="top",
            ha="right",
            fontsize=7,
            color="C3",
        )


def overview(record: FlightRecord, width: int = 1400, height: int = 1000) -> RgbImage:
    """The flight over time: commands and stick pulses, what was seen, ages and latency, and the latency's histogram.

    Green: commands were sent; red: they were released; red lines carry the reason.
    """
    figure = _figure(width, height)
    places = _grid(figure, 3, 2)
    name = f"{record.path.name}: {record.start.get('task', '?')}, model {record.start.get('model', '?')}"
    figure.suptitle(name + (", dry run" if record.start.get("dry_run") else ""))
    time_s = record.column(record.states, "time_s")
    frame_s = record.column(record.frames, "time_s")

    velocity = record.vectors(record.states, "velocity_m_s", 3)
    for i, axis in enumerate(("forward", "right", "down")):
        places[0, 0].plot(time_s, velocity[:, i], label=axis, lw=1)
    places[0, 0].set_ylabel("commanded velocity, m/s")
    places[0, 0].margins(y=0.25)
    places[0, 0].legend(loc="lower right", fontsize=8, ncols=3)

    pulses = record.vectors(record.states, "pulses_us", 18)
    for channel in np.nonzero((pulses > 0).any(axis=0))[0]:
        shown = np.where(pulses[:, channel] > 0, pulses[:, channel], np.nan)
        places[0, 1].plot(time_s, shown, label=f"channel {channel + 1}", lw=1)
    switch = record.column(record.states, "switch_us")
    places[0, 1].plot(time_s, np.where(switch > 0, switch, np.nan), "k:", lw=1, label="pilot's switch")
    places[0, 1].set_ylim(750, 2100)
    places[0, 1].set_ylabel("pulse, µs")
    places[0, 1].legend(loc="lower right", fontsize=8, ncols=3)

    places[1, 0].plot(frame_s, record.column(record.frames, "mean_uncertainty"), lw=1)
    places[1, 0].set_ylabel("mean uncertainty")
    places[1, 1].plot(frame_s, record.column(record.frames, "mean_flow_px"), lw=1, color="C2")
    places[1, 1].set_ylabel("mean flow, px")

    for key, label in (("frame_age_s", "frame"), ("command_age_s", "command's frame"), ("rc_age_s", "RC channels")):
        places[2, 0].plot(time_s, np.maximum(1e3 * record.column(record.states, key), 1.0), label=label, lw=1)
    places[2, 0].set_yscale("log")
    places[2, 0].set_ylim(bottom=0.3)
    places[2, 0].set_ylabel("age, ms")
    places[2, 0].legend(loc="lower right", fontsize=8, ncols=3)

    latency = record.column(record.frames, "latency_ms")
    latency = latency[np.isfinite(latency)]
    if latency.size:
        top = max(float(np.quantile(latency, 0.999)), 1.0)
        places[2, 1].hist(np.minimum(latency, top), bins=60, color="C0")
        for share, style in ((0.5, "-"), (0.95, "--"), (0.99, ":")):
            at = float(np.quantile(latency, share))
            places[2, 1].axvline(at, color="k", ls=style, lw=1, label=f"p{share * 100:.0f}: {at:.1f} ms")
        places[2, 1].legend(fontsize=8)
    places[2, 1].set_xlabel("latency, capture to command, ms")
    places[2, 1].set_ylabel("frames")

    for place in places.flat:
        place.set_xmargin(0.01)
        if place is not places[2, 1]:
            place.set_xlabel("time, s")
            _shade(place, record)
    _mark_releases(places[0, 0], record)
    return _rgb(figure)


# --- video ---------------------------------------------------------------------------------------------------------


def frame_pictures(record: FlightRecord) -> Iterator[tuple[float, RgbImage]]:
    """The kept frames (``log.frame_every``) with the state and the command of their time: (seconds, picture)."""
    from ajna import io

    folder = record.path.with_suffix("")
    times = record.column(record.states, "time_s")
    for row in record.frames:
        path = folder / f"{int(row.get('index', -1)):06d}.jpg"
        if not path.is_file():
            continue
        at = max(int(np.searchsorted(times, row["time_s"], side="right")) - 1, 0)
        yield float(row["time_s"]), _picture(io.read_image(path), row, record.states[at])


def _picture(frame: RgbImage, row: Row, state: Row) -> RgbImage:
    height, width = frame.shape[:2]
    scale = max(1, -(-_MIN_WIDTH_PX // width))
    image = Image.new("RGB", (scale * width, scale * height + _HEAD_PX), "black")
    image.paste(Image.fromarray(frame).resize((scale * width, scale * height), Image.Resampling.NEAREST), (0, _HEAD_PX))
    draw = ImageDraw.Draw(image)
    name = str(state.get("state"))
    color = {"active": (60, 255, 60), "releasing": (255, 60, 60)}.get(name, (200, 200, 200))
    font = ImageFont.load_default()
    fault = state.get("fault")
    why = f" ({fault})" if name != "active" and fault not in (None, "none") else ""
    draw.text((6, 4), f"{row['time_s']:8.2f} s  {name}{why}  {state.get('mode')}", fill=color, font=font)
    velocity = row.get("velocity_m_s") or [0.0, 0.0, 0.0]
    text = f"{row.get('status')}: {row.get('command')} {velocity[0]:+.1f} {velocity[1]:+.1f} {velocity[2]:+.1f} m/s"
    draw.text((6, 20), f"{text}  {row.get('latency_ms') or 0:.0f} ms", fill=(255, 255, 255), font=font)
    # Where the command goes in the image plane: right and down.
    center = (scale * width / 2, _HEAD_PX + scale * height / 2)
    reach = scale * width / 12
    tip = (center[0] + reach * velocity[1], center[1] + reach * velocity[2])
    draw.line([center, tip], fill=color, width=3)
    draw.ellipse([tip[0] - 4, tip[1] - 4, tip[0] + 4, tip[1] + 4], fill=color)
    return np.asarray(image)
