# SPDX-License-Identifier: MIT
"""What an exported file says about itself."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ajna import _core
from ajna.nn import FlowNet, count_parameters, metadata_object

PREFIX = "ajna."  # of every key in a file


def checkpoint_strings(net: FlowNet, metadata: Mapping[str, Any]) -> dict[str, str]:
    """The checkpoint's metadata as Ajna's engine reads them from a TorchScript file."""
    return metadata_object(net, metadata).to_strings()


def record(
    net: FlowNet, metadata: Mapping[str, Any], file_format: str, size: tuple[int, int], calibration_pairs: int = 0
) -> dict[str, str]:
    """Key and value as text: what model this is, and all that one needs to know to feed it and to read its outputs.

    Args:
        size: (width, height), which the file fixes.
        calibration_pairs: how many pairs of frames int8 was calibrated on.
    """
    calibration = metadata.get("calibration")
    entries = {
        "name": metadata["name"],
        "format": file_format,
        "version": _core.__version__,
        "loss": metadata["loss"],
        "flow_scale": repr(float(metadata["flow_scale"])),
        "parameters": str(count_parameters(net)),
        "stride": str(net.config.stride),
        "provenance": json.dumps(dict(metadata["provenance"])),
        "input": "[N, 6, H, W] float32: RGB of frame 1, then of frame 2, each x / 127.5 - 1",
        "raw": "[N, 4, H, W]: what the network gives; times flow_scale its first two channels are pixels",
        "flow": "[N, 2, H, W] pixels, u to the right and v down: where the pixels of frame 1 are in frame 2",
        "uncertainty": "[N, 2, H, W] positive, in the unit of the loss, of u and of v; larger is less certain",
        "width": str(size[0]),
        "height": str(size[1]),
        "expected_error": "[N, 2, H, W] pixels: the error that the network expects of itself",
    }
    if calibration_pairs:
        entries["int8_calibration_pairs"] = str(calibration_pairs)
    if calibration is not None:
        entries["calibration"] = json.dumps(
            {
                "levels": list(calibration.factors.levels),
                "factors": [list(row) for row in calibration.factors.factors],
                **dict(calibration.provenance),
            }
        )
    return {PREFIX + key: str(value) for key, value in entries.items()}
