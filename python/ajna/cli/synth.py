# SPDX-License-Identifier: MIT
"""``ajna synth``: the synthetic scenes, listed and looked at."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ajna.cli.options import JsonOption, parse_size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ajna.synth import PairBatch

app = typer.Typer(
    help="The synthetic scenes: list their presets, look at them.",
    epilog="Example: ajna synth preview --preset gap --out gap.png",
    no_args_is_help=True,
)

_GUTTER, _GAP = 92, 3  # pixels: room for the names of the rows, space between pictures
_MAX_COLUMNS = 64


@app.command()
def presets(as_json: JsonOption = False) -> None:
    """The scene presets and what is seen in them.

    Example: ajna synth presets
    """
    from ajna import synth

    found = synth.presets()
    if as_json:
        typer.echo(json.dumps([{"name": name, "summary": summary} for name, summary in found.items()]))
        return
    width = max(map(len, found))
    for name, summary in found.items():
        typer.echo(f"{name:{width}}  {summary}")


@app.command()
def preview(
    out: Annotated[Path, typer.Option(help="The picture to write, for example scenes.png.", show_default=False)],
    preset: Annotated[str, typer.Option(help="Scene preset; see ajna synth presets.")] = "general",
    columns: Annotated[int, typer.Option(min=1, max=_MAX_COLUMNS, help="Frame pairs, side by side.")] = 6,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of a frame.")] = "128x96",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """A contact sheet of frame pairs of a scene preset: both frames, flow, occlusion and motion boundaries.

    Textures are procedural. Flow is in Middlebury colours, with one scale for the whole sheet.

    Example: ajna synth preview --preset dodge --out dodge.png
    """
    chosen = parse_size(size)
    assert chosen is not None
    if out.suffix.lower() != ".png":
        raise ValueError(f"output '{out}' is not a .png file: give for example --out scenes.png")
    if out.is_dir():
        raise ValueError(f"output '{out}' is a folder: give --out the name of a file")

    from PIL import Image

    from ajna import synth
    from ajna.cli.outputs import check_folder, staged_folder

    config = synth.scene_config({"preset": preset})
    check_folder(out.parent)
    width, height = chosen
    pairs = synth.PairGenerator(config, bank_seed=seed)(columns, height, width, seed)
    picture, max_flow = contact_sheet(pairs)
    with staged_folder(out.parent) as stage:
        Image.fromarray(picture).save(stage / out.name, format="PNG", optimize=True)

    length = pairs.flow.norm(dim=1)
    summary: dict[str, Any] = {
        "preset": preset,
        "file": str(out),
        "pairs": columns,
        "mean_flow_px": float(length.mean()),
        "max_flow_px": float(length.max()),
        "flow_scale_px": max_flow,
        "occluded_fraction": float(pairs.occlusion.float().mean()),
    }
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        typer.echo(
            f"wrote {out}: {columns} pairs of {width}x{height}, flow {summary['mean_flow_px']:.2f} px on average, "
            f"{summary['max_flow_px']:.1f} px at most, {100 * summary['occluded_fraction']:.1f} % occluded"
        )


def contact_sheet(pairs: PairBatch) -> tuple[NDArray[np.uint8], float]:
    """Rows of frame 1, frame 2, flow, occlusion and motion boundaries; one column per pair.

    Returns:
        RGB uint8 [height, width, 3], and the flow's scale in pixels.
    """
    import numpy as np
    from PIL import Image, ImageDraw

    from ajna import viz

    flow = pairs.flow.permute(0, 2, 3, 1).cpu().numpy()
    max_flow = viz.robust_scale(np.linalg.norm(flow, axis=3))
    rows = {
        "frame 1": pairs.frame1.permute(0, 2, 3, 1).cpu().numpy(),
        "frame 2": pairs.frame2.permute(0, 2, 3, 1).cpu().numpy(),
        f"flow, {max_flow:g} px": np.stack([viz.flow_to_image(each, max_flow) for each in flow]),
        "occlusion": _mask_pictures(pairs.occlusion.cpu().numpy()),
        "boundaries": _mask_pictures(pairs.motion_boundary.cpu().numpy()),
    }
    count, height, width = flow.shape[:3]
    sheet = Image.new(
        "RGB", (_GUTTER + count * (width + _GAP) + _GAP, len(rows) * (height + _GAP) + _GAP), (255, 255, 255)
    )
    draw = ImageDraw.Draw(sheet)
    for number, (name, pictures) in enumerate(rows.items()):
        top = _GAP + number * (height + _GAP)
        draw.text((6, top + height / 2), name, fill=(0, 0, 0), anchor="lm")
        for column, picture in enumerate(pictures):
            sheet.paste(Image.fromarray(picture), (_GUTTER + _GAP + column * (width + _GAP), top))
    return np.asarray(sheet), max_flow


def _mask_pictures(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """bool [B, 1, H, W] to black on light grey, uint8 [B, H, W, 3]."""
    import numpy as np

    return np.where(mask[:, 0, :, :, None], 0, 225).repeat(3, axis=3).astype(np.uint8)
