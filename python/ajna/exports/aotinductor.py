# SPDX-License-Identifier: MIT
"""A package of machine code by torch's AOTInductor (.pt2): for processors like this one, any batch, H and W fixed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from ajna.exports.graph import ExportableNet, quiet


def write(path: Path, net: ExportableNet, width: int, height: int, entries: Mapping[str, str]) -> None:
    """Compile ``net`` (by the system's C++ compiler, about a minute) into ``path`` with ``entries`` as its metadata."""
    from torch._inductor import aoti_compile_and_package

    example = torch.zeros(1, 6, height, width)
    with quiet():
        program = torch.export.export(net, (example,), strict=False)
        aoti_compile_and_package(
            program,
            package_path=str(path),
            # Freezing lets it choose the layout of weights, and repack them once.
            inductor_configs={"freezing": True, "aot_inductor.metadata": dict(entries)},
        )
