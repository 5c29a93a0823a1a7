# SPDX-License-Identifier: MIT
"""``ajna video``: frame, flow and uncertainty side by side over a whole video."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ajna.cli.options import DeviceOption, JsonOption, ModelOption, SizeOption, ThreadsOption, parse_size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ajna import io

_SCALE_PAIRS = 8  # pairs that decide the fixed colour scale
_FALLBACK_FPS = 30.0  # cameras that do not tell


class _Shown(NamedTuple):
    frame: NDArray[np.uint8]
    field: Any


class _Scale(NamedTuple):
    flow_px: float
    uncertainty: float


def video(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="Folder of images, video file, or camera index such as 0.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option(help="The video to write: .mp4 or .avi.", show_default=False)],
    model: ModelOption = "best",
    size: SizeOption = None,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    max_frames: Annotated[int | None, typer.Option(min=2, help="Stop after this many frames of the source.")] = None,
    fps: Annotated[
        float | None, typer.Option(min=0.01, max=1000.0, help="Frames per second of the result; default: the source's.")
    ] = None,
    max_flow: Annotated[
        float | None, typer.Option(min=1e-6, help="Flow in pixels that is shown fully saturated.")
    ] = None,
    max_uncertainty: Annotated[float | None, typer.Option(min=1e-6, help="Uncertainty that is shown yellow.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Flow and uncertainty of a video: frame | flow | uncertainty, one picture per pair of frames.

    The colour scale is the same over the whole video: by default it covers 99 % of the values in the first 8 pairs.
    Ctrl-C ends a camera's recording and keeps it; with other sources it leaves nothing.

    Example: ajna video street.avi --out street_flow.mp4 --size 320x240 --max-frames 100
    """
    target_size = parse_size(size)
    if out.suffix.lower() not in (".mp4", ".avi"):
        raise ValueError(f"video '{out}' has the unknown extension '{out.suffix}': give --out a name in .mp4 or .avi")

    import ajna
    from ajna import io
    from ajna.cli.outputs import check_folder, made_folder

    check_folder(out.parent)
    if out.is_dir():
        raise ValueError(f"output '{out}' is a folder: give --out the name of a file")
    frames = io.VideoSource(source, fps=fps)
    network = ajna.load(model, device=device, threads=threads)
    rate = fps or (frames.fps if 0 < frames.fps <= 1000 else _FALLBACK_FPS)
    expected = _expected_frames(frames, max_frames)

    width, height = target_size or (frames.width, frames.height)
    scale: _Scale | None = None
    with made_folder(out.parent), io.VideoWriter(out, 3 * width, height, rate) as writer:
        pairs = _pairs(_progress(_until_interrupt(frames), expected), network, target_size, max_frames)
        for scale, shown in _scaled(pairs, max_flow, max_uncertainty):
            writer.write(_picture(shown, scale))
        if scale is None:
            raise ValueError(f"video '{source}' holds a single frame: flow needs at least two")
    summary = {
        "frames": writer.frames_written + 1,
        "fps": rate,
        "width": 3 * width,
        "height": height,
        "max_flow_px": scale.flow_px,
        "max_uncertainty": scale.uncertainty,
        "file": str(out),
    }
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        typer.echo(
            f"{summary['frames']} frames at {rate:g} per second; colour scale: flow to {scale.flow_px:g} px, "
            f"uncertainty to {scale.uncertainty:g}; wrote {out}"
        )


def _expected_frames(frames: io.VideoSource, max_frames: int | None) -> int | None:
    counts = [count for count in (frames.frame_count, max_frames) if count is not None]
    return min(counts) if counts else None


def _until_interrupt(frames: io.VideoSource) -> Iterator[io.Frame]:
    """The frames; on a camera, which has no end, Ctrl-C is the end (wherever in the loop it arrives)."""
    if not frames.is_camera:
        yield from frames
        return
    stop = False

    def on_interrupt(number: int, stack: object) -> None:
        nonlocal stop
        stop = True

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        while not stop and (frame := frames.next()) is not None:
            yield frame
    finally:
        signal.signal(signal.SIGINT, before)


def _progress(frames: Iterable[io.Frame], total: int | None) -> Iterator[io.Frame]:
    """The frames, with a progress bar on stderr where that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("frames", total=total)
        for frame in frames:
            yield frame
            progress.advance(task)


def _pairs(
    frames: Iterable[io.Frame], network: Any, size: tuple[int, int] | None, max_frames: int | None
) -> Iterator[_Shown]:
    from ajna.data.pairs import resize_area

    previous: NDArray[np.uint8] | None = None
    for index, frame in enumerate(frames, start=1):
        image = frame.image if size is None else resize_area(frame.image, *size)
        if previous is not None:
            yield _Shown(previous, network(previous, image))
        previous = image
        if index == max_frames:
            return


def _scaled(
    pairs: Iterator[_Shown], max_flow: float | None, max_uncertainty: float | None
) -> Iterator[tuple[_Scale, _Shown]]:
    """Each pair with the one colour scale, which the first pairs decide unless it is given."""
    from itertools import chain, islice

    import numpy as np

    from ajna.viz import robust_scale

    head = [] if max_flow is not None and max_uncertainty is not None else list(islice(pairs, _SCALE_PAIRS))
    scale = _Scale(
        max_flow or robust_scale(*(np.linalg.norm(shown.field.flow, axis=2) for shown in head)),
        max_uncertainty or robust_scale(*(np.linalg.norm(shown.field.uncertainty, axis=2) for shown in head)),
    )
    for shown in chain(head, pairs):
        yield scale, shown


def _picture(shown: _Shown, scale: _Scale) -> NDArray[np.uint8]:
    """Frame | flow | uncertainty -> uint8 [H, 3 W, 3]."""
    import numpy as np

    from ajna import viz

    return np.concatenate(
        [
            shown.frame,
            viz.flow_to_image(shown.field.flow, scale.flow_px),
            viz.uncertainty_to_image(shown.field.uncertainty, 0.0, scale.uncertainty),
        ],
        axis=1,
    )
