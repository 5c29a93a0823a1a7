# SPDX-License-Identifier: MIT
"""TorchScript in bfloat16 with the methods and the metadata of the float32 file: Ajna's engine loads it, too."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ajna.exports.graph import exportable, quiet, to_channels_last
from ajna.exports.record import checkpoint_strings
from ajna.nn import FlowNet, network_input

METADATA_FILE = "ajna.json"  # where the engine looks: ajna::nn::kScriptMetadataFile ...
PRECISION_FILE = "ajna_precision.txt"  # ... and kScriptPrecisionFile


class _Script(nn.Module):
    """What C++ gives the float32 file: forward at any size, and predict."""

    def __init__(self, network: Any, preprocess: Any, table: Any, stride: int, flow_scale: float) -> None:
        super().__init__()
        self.network, self.preprocess, self.table = network, preprocess, table
        self.stride, self.flow_scale = stride, flow_scale

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.size(2), x.size(3)
        pad_y = (self.stride - height % self.stride) % self.stride
        pad_x = (self.stride - width % self.stride) % self.stride
        if pad_y > 0 or pad_x > 0:
            x = torch.nn.functional.pad(x, [0, pad_x, 0, pad_y], mode="replicate")
        x = x.to(torch.bfloat16).contiguous(memory_format=torch.channels_last)
        return self.network(x).to(torch.float32)[:, :, :height, :width]

    @torch.jit.export
    def predict(self, frame1: Tensor, frame2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raw = self.forward(self.preprocess(frame1, frame2))
        uncertainty, expected_error = self.table(raw[:, 2:4])
        return raw[:, 0:2] * self.flow_scale, uncertainty, expected_error * self.flow_scale


def write(path: Path, net: FlowNet, metadata: Mapping[str, Any]) -> None:
    """Write ``net`` to ``path`` with weights and activations in bfloat16; input and outputs are float32, any size."""
    parts = exportable(net, metadata, torch.bfloat16)
    to_channels_last(parts.network)
    side = 2 * net.config.stride
    frame = torch.zeros(1, 3, side, side, dtype=torch.uint8)
    with quiet():  # torch plans to retire TorchScript; the user asked for it
        script = torch.jit.script(
            _Script(
                torch.jit.trace(parts.network, torch.zeros(1, 6, side, side, dtype=torch.bfloat16)),
                torch.jit.trace(network_input, (frame, frame.clone())),
                torch.jit.trace(parts.table, torch.zeros(1, 2, side, side)),
                net.config.stride,
                parts.flow_scale,
            ).eval()
        )
        frozen = torch.jit.freeze(script, preserved_attrs=["predict"])
        files = {METADATA_FILE: json.dumps(checkpoint_strings(net, metadata)), PRECISION_FILE: "bfloat16"}
        torch.jit.save(frozen, str(path), files)
