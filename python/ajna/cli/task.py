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
    only). dodge, navigate and segment take neighbouring frames as pairs; gap pairs every frame with the first, until it
    has found one.

    Example: ajna task dodge ball/*.png --out dodged --video
    """
    from ajna import _core

    skills: dict[str, Callable[..., Iterator[Answer]]] = {
        "dodge": _dodge,
        "navigate": _navigate,
        "gap": _gap,
        "segment": _segment,
    }
    if skill not in skills:
        near = _core.nearest_name(skill, list(skills))
        hint = f", did you mean '{near}'?" if near else ""
        raise ValueError(f"unknown skill '{skill}'{hint} Known: {', '.join(skills)}")
    target_size = parse_size(size)

    import ajna
    from ajna import io
    from ajna.cli.outputs import check_folder, staged_folder

    check_folder(out)
    rate, stamped = _frames(frames, fps, target_size)
    network = ajna.load(model, device=device, threads=threads)
    counts: dict[str, int] = {}
    with staged_folder(out) as stage:
        writer: Any = None
        pictures = 0
        try:
            with (stage / COMMANDS_FILE).open("w", encoding="utf-8") as lines:
                for pictures, (picture, line) in enumerate(skills[skill](stamped, network, math.radians(fov)), start=1):
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


def _pairs(stamped: Iterator[Stamped]) -> Iterator[tuple[Stamped, Stamped]]:
    before: Stamped | None = None
    for frame in stamped:
        if before is not None:
            yield before, frame
        before = frame


def _line(name: str, time_s: float, status: str, command: Any, **found: Any) -> dict[str, Any]:
    from ajna import tasks

    line: dict[str, Any] = {"frame": name, "time_s": round(time_s, 6), "status": status, **found}
    if command is not None:
        line["command"] = tasks.command_dict(command)
    return line


def _point(vector: Any) -> list[float] | None:
    return None if vector is None else [round(float(value), 3) for value in vector]


def _dodge(stamped: Iterator[Stamped], network: Any, fov_rad: float) -> Iterator[Answer]:
    from ajna import task_overlays, tasks

    options = tasks.DodgeOptions()
    options.horizontal_fov_rad = fov_rad
    pipeline, policy = tasks.DodgePipeline(options), tasks.DodgePolicy()
    for (_, _, first), (time_s, name, second) in _pairs(stamped):
        uncertainty = network(first, second, time_s).uncertainty
        result = pipeline.step(uncertainty, time_s)
        command = policy.update(result.safe_direction, time_s)
        incoming = result.status == "incoming"
        found = {
            "center_px": _point(result.track[-1].center_px) if result.region else None,
            "box": list(result.region.box) if result.region else None,
            "velocity_px_s": _point(result.velocity_px_s) if incoming else None,
            "impact_px": _point(result.impact_px) if incoming else None,
            "time_to_contact_s": round(result.time_to_contact_s, 4) if incoming else None,
            "safe_direction": _point(result.safe_direction),
        }
        yield (
            task_overlays.dodge_overlay(first, uncertainty, result, command),
            _line(name, time_s, result.status, command, **found),
        )


def _navigate(stamped: Iterator[Stamped], network: Any, fov_rad: float) -> Iterator[Answer]:
    from ajna import task_overlays, tasks

    options = tasks.NavigateOptions()
    options.horizontal_fov_rad = fov_rad
    pipeline, policy = tasks.NavigatePipeline(options), tasks.NavigatePolicy()
    for (_, _, first), (time_s, name, second) in _pairs(stamped):
        uncertainty = network(first, second, time_s).uncertainty
        result = pipeline.step(uncertainty, time_s)
        command = policy.update(tasks.guidance(result), time_s)
        found = {
            "weight": round(result.weight, 4),
            "goal_px": _point(result.goal_px),
            "safe_px": _point(result.free_px) if result.status == "ok" else None,
            "goal_direction": _point(result.goal_direction),
            "free_direction": _point(result.free_direction) if result.status == "ok" else None,
        }
        yield (
            task_overlays.navigate_overlay(first, uncertainty, result, command),
            _line(name, time_s, result.status, command, **found),
        )


def _gap(stamped: Iterator[Stamped], network: Any, fov_rad: float) -> Iterator[Answer]:
    from ajna import task_overlays, tasks

    options = tasks.GapOptions()
    options.min_pairs = 1  # recorded frames may be few; a vehicle stacks more before it looks
    pipeline, policy = tasks.GapPipeline(options, fov_rad), tasks.GapPolicy()
    explore = tasks.ExploreOptions()
    reference: Any = None
    shown: Any = None  # the last stacked map: while tracking there is no new one
    for index, (time_s, name, frame) in enumerate(stamped):
        uncertainty = None
        if pipeline.wants_map:
            # Without the motion of the wall: what is seen through the gap then moves before a wall at rest.
            aligned = tasks.align_to(reference, frame)
            uncertainty = aligned.within(network(reference, aligned.image, time_s).uncertainty)
        result = pipeline.step(frame, uncertainty, time_s)
        shown = shown if result.stacked is None else result.stacked
        if index == 0 or result.status == "no_gap":
            reference = frame
        if index == 0:
            continue
        if result.status in ("exploring", "no_gap"):
            command = tasks.explore(explore, time_s)
        else:
            offset = result.safe_offset if result.status == "tracking" else None
            command = policy.update(offset, result.status == "through", time_s)
        tracking = result.status == "tracking"
        found = {
            "pairs": result.pairs,
            "safe_px": _point(result.safe_px) if tracking else None,
            "safe_offset": _point(result.safe_offset) if tracking else None,
            "side": result.side if tracking else None,
        }
        yield (
            task_overlays.gap_overlay(frame, shown, result, command),
            _line(name, time_s, result.status, command, **found),
        )


def _segment(stamped: Iterator[Stamped], network: Any, fov_rad: float) -> Iterator[Answer]:
    import numpy as np

    from ajna import task_overlays, tasks

    for (_, _, first), (time_s, name, second) in _pairs(stamped):
        # Without the motion of the table: what stands on it then moves before a table at rest.
        aligned = tasks.align_to(first, second)
        uncertainty = aligned.within(network(first, aligned.image, time_s).uncertainty)
        result = tasks.segment_pile(first, uncertainty)
        done = result.status == "ok"
        found = {
            "box": list(result.box) if done else None,
            "attention_px": int(np.count_nonzero(np.asarray(result.attention))) if done else 0,
            "segmentation_px": int(np.count_nonzero(np.asarray(result.segmentation))) if done else 0,
        }
        yield (
            task_overlays.segment_overlay(first, uncertainty, result),
            _line(name, time_s, result.status, None, **found),
        )
