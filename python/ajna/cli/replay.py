# SPDX-License-Identifier: MIT
"""``ajna replay``: what happened in a flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from ajna.cli.options import JsonOption


def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A flight-0001.jsonl of ajna_flight.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the results; made if missing.", show_default=False)],
    as_json: JsonOption = False,
) -> None:
    """Plots and a video of a flight from its log.

    Writes overview.png, and flight.mp4 where the log kept frames (log.frame_every of the configuration).

    Example: ajna replay log/flight-0001.jsonl --out replay
    """
    from ajna import flight_log, io
    from ajna.cli.outputs import check_folder, staged_folder

    check_folder(out)
    record = flight_log.read_log(log)
    summary: dict[str, Any] = record.summary()
    with staged_folder(out) as stage:
        io.write_image(stage / "overview.png", flight_log.overview(record))
        summary["video_frames"] = _video(record, stage / "flight.mp4")
    if as_json:
        typer.echo(json.dumps(summary))
        return
    for event in record.events:
        typer.echo(f"{event['time_s']:8.2f} s  {event.get('text')}")
    latency = summary["latency_p50_ms"]
    speed = "" if latency is None else f", latency median {latency:.1f} ms, p99 {summary['latency_p99_ms']:.1f} ms"
    typer.echo(
        f"{summary['duration_s']:.1f} s, of which commands were sent for {summary['active_s']:.1f} s; "
        f"{summary['frames']} frames{speed}; {summary['releases']} releases; wrote {out}"
    )
    if record.skipped_lines or not record.end:
        typer.echo(f"the log is incomplete: {record.skipped_lines} damaged lines, {'an' if record.end else 'no'} end")


def _video(record: Any, path: Path) -> int:
    """The kept frames as a video at their mean rate; the number written, 0 where there are fewer than two."""
    from itertools import islice

    from ajna import flight_log, io

    times = [row["time_s"] for row in record.frames]
    folder = record.path.with_suffix("")
    if not folder.is_dir():
        return 0
    head = list(islice(flight_log.frame_pictures(record), 2))
    if len(head) < 2:
        return 0
    every = max(int(record.start.get("frame_every") or 1), 1)
    span = times[-1] - times[0]
    rate = min(max((len(times) - 1) / span / every if span > 0 else 30.0, 0.1), 240.0)
    height, width = head[0][1].shape[:2]
    with io.VideoWriter(path, width, height, rate) as writer:
        for _, picture in flight_log.frame_pictures(record):
            if picture.shape[:2] == (height, width):
                writer.write(picture)
    return int(writer.frames_written)
