# SPDX-License-Identifier: MIT
"""``ajna predict``: flow and uncertainty of one frame pair."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ajna.cli.options import DeviceOption, JsonOption, ModelOption, SizeOption, ThreadsOption, parse_size

FILES = ("flow.flo", "uncertainty.pfm", "flow.png", "uncertainty.png", "overview.png")


def predict(
    img1: Annotated[
        Path, typer.Argument(metavar="IMG1", help="First frame: PNG, JPEG, BMP, PPM or PGM.", show_default=False)
    ],
    img2: Annotated[Path, typer.Argument(metavar="IMG2", help="Second frame, of the same size.")],
    out: Annotated[Path, typer.Option(help="Folder for the results; made if missing.", show_default=False)],
    model: ModelOption = "best",
    size: SizeOption = None,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Optical flow from IMG1 to IMG2 and its uncertainty.

    Writes flow.flo (pixels), uncertainty.pfm (x, y and a zero plane, as .pfm has no two-plane form), flow.png
    (Middlebury colours), uncertainty.png (blue: certain, yellow: uncertain) and overview.png (all, with scales).

    Example: ajna predict frame1.png frame2.png --out result --size 320x240
    """
    target_size = parse_size(size)

    import numpy as np

    import ajna
    from ajna import io, viz
    from ajna.cli.outputs import check_folder, staged_folder
    from ajna.data.pairs import resize_area

    check_folder(out)
    frame1, frame2 = io.read_image(img1), io.read_image(img2)
    if frame1.shape != frame2.shape:
        sizes = [f"{frame.shape[1]}x{frame.shape[0]}" for frame in (frame1, frame2)]
        raise ValueError(f"image '{img1}' is {sizes[0]} but '{img2}' is {sizes[1]}: give two images of equal size")
    if target_size is not None:
        frame1, frame2 = resize_area(frame1, *target_size), resize_area(frame2, *target_size)
    field = ajna.load(model, device=device, threads=threads)(frame1, frame2)

    with staged_folder(out) as stage:
        io.write_flo(stage / "flow.flo", field.flow)
        io.write_pfm(stage / "uncertainty.pfm", field.uncertainty)
        io.write_image(stage / "flow.png", viz.flow_to_image(field.flow))
        io.write_image(stage / "uncertainty.png", viz.uncertainty_to_image(field.uncertainty))
        io.write_image(stage / "overview.png", viz.overview(frame1, frame2, field))

    length = np.linalg.norm(field.flow, axis=2)
    summary = {
        "width": frame1.shape[1],
        "height": frame1.shape[0],
        "mean_flow_px": float(length.mean()),
        "max_flow_px": float(length.max()),
        "mean_uncertainty": float(np.linalg.norm(field.uncertainty, axis=2).mean()),
        "mean_expected_error_px": float(np.linalg.norm(field.expected_error, axis=2).mean()),
        "files": [str(out / name) for name in FILES],
    }
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        typer.echo(
            f"{summary['width']}x{summary['height']}: flow {summary['mean_flow_px']:.2f} px on average, "
            f"{summary['max_flow_px']:.2f} px at most, expected error {summary['mean_expected_error_px']:.2f} px; "
            f"wrote {', '.join(FILES)} in {out}"
        )
