# SPDX-License-Identifier: MIT
"""``ajna task``: a robot skill on recorded frames: overlay pictures, and commands as JSON lines."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import DeviceOption, JsonOption, ModelOption, SizeOption, ThreadsOption, parse_size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Stamped = tuple[float, str, NDArray[np.uint8]]  # time stamp, name, RGB frame
    Answer = tuple[NDArray[np.uint8], dict[str, Any]]  # overlay, what the JSON line says

COMMANDS_FILE = "commands.jsonl"
VIDEO_FILE = "overlay.mp4"
SLOWEST_HZ = 2.0  # frames further apart are no pairs
_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm"}

SkillArgument = Annotated[
    str, typer.Argument(metavar="SKILL", help="dodge, navigate, gap or segment.", show_default=False)
]


def task(
    skill: SkillArgument,
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAMES...", help="Two images or more, in order; or one folder or video.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; made if missing.", show_default=False)],
    model: ModelOption = "best",
    size: SizeOption = "320x240",
    fps: Annotated[
        float | None, typer.Option(min=0.01, max=1000.0, help="Frames per second; default: the video's, else 30.")
    ] = None,
    fov: Annotated[
        float, typer.Option(min=1.0, max=179.0, help="Horizontal field of view of the camera, degrees.")
    ] = 69.0,
    video: Annotated[bool, typer.Option("--video", help=f"Write {VIDEO_FILE} as well.")] = False,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """One of the four skills on recorded frames, from the uncertainty of optical flow alone.

    Writes one overlay picture per pair (frame_0001.png, ...) and commands.jsonl: per line frame, time, status, what was
    found, and the command for the autopilot (body frame: forward, right, down; none for segment, which is perception
    only). dodge and navigate take pairs as in flight, which span up to 0.17 and 0.1 s; segment takes neighbouring
    frames; gap pairs every frame with the first, until it has found one.

    Example: ajna task dodge ball/*.png --out dodged --video
    """
    from ajna import _core, tasks

    if skill not in tasks.SKILLS:
        near = _core.nearest_name(skill, list(tasks.SKILLS))
        hint = f", did you mean '{near}'?" if near else ""
        raise ValueError(f"unknown skill '{skill}'{hint} Known: {', '.join(tasks.SKILLS)}")
    target_size = parse_size(size)

    import ajna
    from ajna import io
    from ajna.cli.outputs import check_folder, staged_folder

    check_folder(out)
    rate, stamped = _frames(frames, fps, target_size)
    network = ajna.load(model, device=device, threads=threads)
    fov_rad = math.radians(fov)
    answers = (
        _segment(stamped, network, fov_rad) if skill == "segment" else _fly(skill, stamped, network, fov_rad, rate)
    )
    counts: dict[str, int] = {}
    with staged_folder(out) as stage:
        writer: Any = None
        pictures = 0
        try:
            with (stage / COMMANDS_FILE).open("w", encoding="utf-8") as lines:
                for pictures, (picture, line) in enumerate(answers, start=1):
                    io.write_image(stage / f"frame_{pictures:04d}.png", picture)
                    lines.write(json.dumps({"skill": skill, **line}) + "\n")
                    counts[line["status"]] = counts.get(line["status"], 0) + 1
                    if video:
                        writer = writer or io.VideoWriter(stage / VIDEO_FILE, picture.shape[1], picture.shape[0], rate)
                        writer.write(picture)
            if not pictures:
                raise ValueError("a single frame has no uncertainty of flow: give two frames or more")
            if writer is not None:
                writer.close()
        except BaseException:
            if writer is not None:
                writer.discard()
            raise
    files = [f"frame_0001.png to frame_{pictures:04d}.png", COMMANDS_FILE, *([VIDEO_FILE] if video else [])]
    if as_json:
        typer.echo(
            json.dumps({"skill": skill, "pairs": pictures, "status": counts, "folder": str(out), "files": files})
        )
    else:
        said = ", ".join(f"{status.replace('_', ' ')} {count}" for status, count in counts.items())
        typer.echo(f"{skill}: {pictures} pairs ({said}); wrote {', '.join(files)} in {out}")


def _frames(sources: list[str], fps: float | None, size: tuple[int, int] | None) -> tuple[float, Iterator[Stamped]]:
    """Frames per second, and the frames with their times; every input is checked before the first is used."""
    from ajna import io
    from ajna.data.pairs import resize_area

    def fitted(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return frame if size is None else resize_area(frame, *size)

    if len(sources) == 1:
        path = Path(sources[0])
        if path.suffix.lower() in _IMAGES and path.is_file():
            raise ValueError(f"'{path}' is a single image: give two frames or more, a folder or a video")
        video = io.VideoSource(sources[0], fps=fps)
        rate = fps or (video.fps if 0 < video.fps <= 1000 else 30.0)
        return rate, ((frame.timestamp_s, frame.name, fitted(frame.image)) for frame in video)
    images = [io.read_image(source) for source in sources]
    for source, image in zip(sources, images, strict=True):
        if size is None and image.shape != images[0].shape:
            raise ValueError(
                f"image '{source}' is {image.shape[1]}x{image.shape[0]} but '{sources[0]}' is "
                f"{images[0].shape[1]}x{images[0].shape[0]}: give frames of equal size, or --size"
            )
    rate = fps or 30.0
    return rate, (
        (index / rate, Path(source).name, fitted(image))
        for index, (source, image) in enumerate(zip(sources, images, strict=True))
    )


def _line(name: str, time_s: float, status: str, command: Any, **found: Any) -> dict[str, Any]:
    from ajna import tasks

    line: dict[str, Any] = {"frame": name, "time_s": round(time_s, 6), "status": status, **found}
    if command is not None:
        line["command"] = tasks.command_dict(command)
    return line


def _point(vector: Any) -> list[float] | None:
    return None if vector is None else [round(float(value), 3) for value in vector]


def _skill(task: str, fov_rad: float, rate_hz: float, network: Any) -> Any:
    """The skill as it is flown, for frames of which nothing but the time is known."""
    from ajna import tasks

    if rate_hz < SLOWEST_HZ:
        raise ValueError(f"{rate_hz:g} frames per second are too few to {task}: give {SLOWEST_HZ:g} or more (--fps)")
    options = tasks.SkillOptions()
    options.task = task
    options.horizontal_fov_rad = fov_rad
    options.planning_rate_hz = min(rate_hz, 200.0)
    options.max_interval_s = max(options.max_interval_s, 1.5 / rate_hz)
    # Recorded frames may be few, and do not begin with a vehicle that comes to rest.
    options.settle_s, options.first_look_s, options.fewest_pairs = 0.0, 0.0, 1
    return tasks.Skill(options, tasks.NetworkSignal(network.engine, fov_rad))


def _fly(task: str, stamped: Iterator[Stamped], network: Any, fov_rad: float, rate_hz: float) -> Iterator[Answer]:
    """Overlay and line of every frame that a pair ends with."""
    from ajna import task_overlays

    told_and_drawn: dict[str, tuple[Callable[[Any], dict[str, Any]], Callable[..., NDArray[np.uint8]]]] = {
        "dodge": (_dodge, task_overlays.dodge_overlay),
        "navigate": (_navigate, task_overlays.navigate_overlay),
        "gap": (_gap, task_overlays.gap_overlay),
    }
    tell, draw = told_and_drawn[task]
    skill = _skill(task, fov_rad, rate_hz, network)
    shown: Any = None  # the last map: while a gap is tracked there is no new one
    for index, (time_s, name, frame) in enumerate(stamped):
        output = skill.plan(time_s, frame)
        result = output.details
        if index == 0 or result is None:
            continue
        stacked = result.stacked if task == "gap" else output.map
        shown = shown if stacked is None else stacked
        found, extra = tell(result), {}
        if task == "dodge":
            outline = skill.outline()
            found["outline_px"] = None if outline is None else int(outline.sum())
            extra["outline"] = outline
        picture = draw(frame, shown, result, output.command, **extra)
        yield picture, _line(name, time_s, output.status, output.command, **found)


def _dodge(result: Any) -> dict[str, Any]:
    incoming = result.status == "incoming"
    return {
        "center_px": _point(result.track[-1].center_px) if result.region else None,
        "box": list(result.region.box) if result.region else None,
        "velocity_px_s": _point(result.velocity_px_s) if incoming else None,
        "impact_px": _point(result.impact_px) if incoming else None,
        "time_to_contact_s": round(result.time_to_contact_s, 4) if incoming else None,
        "safe_direction": _point(result.safe_direction),
    }


def _navigate(result: Any) -> dict[str, Any]:
    return {
        "weight": round(result.weight, 4),
        "goal_px": _point(result.goal_px),
        "safe_px": _point(result.free_px) if result.status == "ok" else None,
        "goal_direction": _point(result.goal_direction),
        "free_direction": _point(result.free_direction) if result.status == "ok" else None,
    }


def _gap(result: Any) -> dict[str, Any]:
    tracking = result.status == "tracking"
    return {
        "pairs": result.pairs,
        "safe_px": _point(result.safe_px) if tracking else None,
        "safe_offset": _point(result.safe_offset) if tracking else None,
        "side": result.side if tracking else None,
    }


def _segment(stamped: Iterator[Stamped], network: Any, fov_rad: float) -> Iterator[Answer]:
    import numpy as np

    from ajna import task_overlays, tasks

    signal = tasks.NetworkSignal(network.engine, fov_rad)
    before: Any = None
    for time_s, name, frame in stamped:
        first, before = before, tasks.Snapshot(time_s, frame, tag=frame)
        if first is None:
            continue
        # Without the motion of the table: what stands on it then moves before a table at rest.
        uncertainty = signal(first, before, "plane")
        result = tasks.segment_pile(first.tag, uncertainty)
        done = result.status == "ok"
        found = {
            "box": list(result.box) if done else None,
            "attention_px": int(np.count_nonzero(np.asarray(result.attention))) if done else 0,
            "segmentation_px": int(np.count_nonzero(np.asarray(result.segmentation))) if done else 0,
        }
        picture = task_overlays.segment_overlay(first.tag, uncertainty, result)
        yield picture, _line(name, time_s, result.status, None, **found)
