# SPDX-License-Identifier: MIT
"""OpenVINO's intermediate representation, in float32 or in int8 by calibration; a .xml and a .bin."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import torch

from ajna.exports.graph import ExportableNet, quiet
from ajna.exports.runners import INPUT, OUTPUTS, Array


def write(
    path: Path,
    net: ExportableNet,
    width: int,
    height: int,
    entries: Mapping[str, str],
    calibration: Sequence[Array] | None = None,
) -> None:
    """Write ``net`` to ``path`` (.xml, and .bin beside it) with ``entries`` as its rt_info 'ajna'; any batch.

    Args:
        calibration: network inputs [1, 6, height, width] float32; with them the convolutions become int8.
    """
    import openvino

    example = torch.zeros(2, 6, height, width)
    with quiet():
        program = torch.export.export(
            net, (example,), dynamic_shapes=({0: torch.export.Dim("batch", min=1)},), strict=False
        )
        model = openvino.convert_model(program, example_input=(example,), input=[(-1, 6, height, width)])
    model.inputs[0].set_names({INPUT})
    for output, name in zip(model.outputs, OUTPUTS, strict=True):
        output.set_names({name})
    if calibration is not None:
        model = _quantized(model, calibration)
    for key, value in entries.items():
        model.set_rt_info(value, key.split("."))
    openvino.save_model(model, str(path), compress_to_fp16=False)


def _quantized(model: Any, calibration: Sequence[Array]) -> Any:
    import nncf

    nncf.set_log_level(logging.ERROR)
    with redirect_stdout(StringIO()):  # its progress bars
        return nncf.quantize(
            model,
            nncf.Dataset(calibration),
            # Inputs of most layers are rectified, the network's input is not: MIXED handles both.
            preset=nncf.QuantizationPreset.MIXED,
            subset_size=len(calibration),
            ignored_scope=nncf.IgnoredScope(names=_after_the_network(model)),
        )


def _after_the_network(model: Any) -> list[str]:
    """Names of the operations that turn the raw output into maps: a table that is looked up takes no rounding."""
    found: list[str] = []
    waiting = [model.output(OUTPUTS[0]).get_node().input_value(0)]  # what the network gives
    while waiting:
        for target in waiting.pop().get_target_inputs():
            node = target.get_node()
            if node.get_type_name() != "Result" and node.get_friendly_name() not in found:
                found.append(node.get_friendly_name())
                waiting += node.outputs()
    return found
