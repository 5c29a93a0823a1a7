# SPDX-License-Identifier: MIT
"""``ajna export``: a model as a file that runs without Ajna."""

from __future__ import annotations

import json
import warnings
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from ajna.cli.options import JsonOption, ModelOption

# Sizes at which the written file is compared with the network: multiples of its stride and others.
_CHECKED_SIZES = ((48, 64), (33, 57), (80, 32))  # (height, width)


class ExportFormat(str, Enum):
    """What can be written."""

    torchscript = "torchscript"


def export(
    out: Annotated[Path, typer.Option(help="The file to write, for example model.pt.", show_default=False)],
    model: ModelOption = "best",
    file_format: Annotated[
        ExportFormat, typer.Option("--format", help="Format of the file.")
    ] = ExportFormat.torchscript,
    as_json: JsonOption = False,
) -> None:
    """Write a model in a format that runs without Ajna, and compare it with the original.

    The TorchScript file has the methods forward (network input [N, 6, H, W] to raw output) and predict (two uint8
    frames [N, 3, H, W] to flow, uncertainty and expected error).

    Example: ajna export --model best --format torchscript --out ajna.pt
    """
    import torch

    import ajna
    from ajna import nn
    from ajna.cli.outputs import check_folder, made_folder

    check_folder(out.parent)
    if out.is_dir():
        raise ValueError(f"output '{out}' is a folder: give --out the name of a file")
    info = ajna.load(model).info
    if info.format != "checkpoint":
        raise ValueError(f"model '{model}' is a {info.format} file already: give a checkpoint (.safetensors)")
    net, metadata = nn.load_checkpoint(info.path)
    with made_folder(out.parent):
        nn.export_torchscript(out, net, metadata)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch plans to retire TorchScript; the user asked for it
        script = torch.jit.load(str(out))
    random = torch.Generator().manual_seed(0)
    difference = 0.0
    with torch.no_grad():
        for height, width in _CHECKED_SIZES:
            x = 2 * torch.rand(1, 6, height, width, generator=random) - 1
            difference = max(difference, float((net(x) - script(x)).abs().max()))
    size_mb = out.stat().st_size / 1e6
    sizes = [f"{width}x{height}" for height, width in _CHECKED_SIZES]
    summary = {
        "model": info.name,
        "format": file_format.value,
        "file": str(out),
        "bytes": out.stat().st_size,
        "max_abs_difference": difference,
        "checked_sizes": sizes,
    }
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        typer.echo(
            f"wrote {out} ({size_mb:.1f} MB); max abs difference to the network {difference:.2g} at {', '.join(sizes)}"
        )
