# SPDX-License-Identifier: MIT
"""ONNX by torch's exporter: opset 18, any batch, H and W fixed."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import torch

from ajna.exports.graph import ExportableNet, quiet
from ajna.exports.runners import INPUT, OUTPUTS

OPSET = 18


def write(path: Path, net: ExportableNet, width: int, height: int, entries: Mapping[str, str]) -> None:
    """Write ``net`` to ``path`` (one file, weights inside) with ``entries`` as metadata_props.

    The batch is dynamic, and input and outputs carry the names of :mod:`ajna.exports.runners`.
    """
    import onnx

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    # Of two frames: torch takes an example's batch of 1 for a constant.
    example = torch.zeros(2, 6, height, width)
    with quiet():
        program = torch.onnx.export(
            net,
            (example,),
            input_names=[INPUT],
            output_names=list(OUTPUTS),
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            dynamic_shapes=({0: torch.export.Dim("batch", min=1)},),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.producer_name = "ajna"
    for key, value in entries.items():
        model.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
