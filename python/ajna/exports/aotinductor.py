# SPDX-License-Identifier: MIT
"""A package of machine code by torch's AOTInductor (.pt2): for processors like this one, one pair of one size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from ajna.exports.graph import ExportableNet, quiet, to_channels_last


class _ChannelsLast(nn.Module):
    """The network with its input in the layout of its weights."""

    def __init__(self, net: ExportableNet) -> None:
        super().__init__()
        self.net = net
        to_channels_last(net)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.net(x.contiguous(memory_format=torch.channels_last))


def write(path: Path, net: ExportableNet, width: int, height: int, entries: Mapping[str, str]) -> None:
    """Compile ``net`` into ``path`` by the system's C++ compiler, in half a minute; ``entries`` are its metadata.

    Raises:
        RuntimeError: the compiler failed.
    """
    from torch._inductor import aoti_compile_and_package

    with quiet():
        program = torch.export.export(_ChannelsLast(net), (torch.zeros(1, 6, height, width),), strict=False)
        aoti_compile_and_package(
            program, package_path=str(path), inductor_configs={"aot_inductor.metadata": dict(entries)}
        )
