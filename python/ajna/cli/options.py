# SPDX-License-Identifier: MIT
"""Options that several commands share, and their checks."""

from __future__ import annotations

import re
from typing import Annotated

import typer

MAX_SIDE = 16384  # pixels

ModelOption = Annotated[str, typer.Option(help="Shipped model by name, or a checkpoint or TorchScript file.")]
DeviceOption = Annotated[str, typer.Option(help="Where the network runs: cpu, cuda, cuda:1, ...")]
ThreadsOption = Annotated[
    int | None, typer.Option(min=1, max=1024, help="CPU threads of the network; by default torch's own choice.")
]
SizeOption = Annotated[
    str | None,
    typer.Option(metavar="WxH", help="Resize the frames first; results have this size. Default: as they are."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


def parse_size(text: str | None) -> tuple[int, int] | None:
    """'320x240' -> (320, 240), None -> None.

    Raises:
        ValueError: for anything else, sides of 0 and sides above MAX_SIDE.
    """
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None:
        raise ValueError(f"size '{text}' is not WIDTHxHEIGHT: give for example --size 320x240")
    width, height = int(match[1]), int(match[2])
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"size {width}x{height} is out of range: give sides of 1 to {MAX_SIDE} pixels")
    return width, height
