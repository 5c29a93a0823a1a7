# SPDX-License-Identifier: MIT
"""``ajna export``: a model as a file that runs without Ajna."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from ajna.cli.options import JsonOption, ModelOption


class ExportFormat(str, Enum):
    """What can be written: the keys of `ajna.exports.FORMATS`."""

    torchscript = "torchscript"
    torchscript_bf16 = "torchscript-bf16"
    onnx = "onnx"
    openvino = "openvino"
    openvino_int8 = "openvino-int8"
    aotinductor = "aotinductor"


def export(
    out: Annotated[Path, typer.Option(help="The file to write, for example model.onnx.", show_default=False)],
    model: ModelOption = "best",
    file_format: Annotated[
        ExportFormat, typer.Option("--format", help="Format of the file.")
    ] = ExportFormat.torchscript,
    width: Annotated[
        int | None, typer.Option(min=1, help="Width in pixels where the format fixes it; default 320.")
    ] = None,
    height: Annotated[
        int | None, typer.Option(min=1, help="Height in pixels where the format fixes it; default 240.")
    ] = None,
    calibration_frames: Annotated[
        Path | None,
        typer.Option(help="For int8: folder of successive images, or a video, like those to come. Default: rendered."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a model in a format that runs without Ajna, and compare it with the original.

    TorchScript files take any size and have the methods forward (network input [N, 6, H, W] to raw output) and predict
    (two uint8 frames [N, 3, H, W] to flow, uncertainty and expected error). The others take the network input at one
    size and give raw, flow, uncertainty and expected_error. They need `pip install "ajna[export]"`.

    Example: ajna export --model best --format onnx --width 640 --height 480 --out ajna.onnx
    """
    import ajna
    from ajna import exports, nn
    from ajna.cli.outputs import check_folder, made_folder

    name = file_format.value
    kind = exports.FORMATS[name]
    check_folder(out.parent)
    if out.is_dir():
        raise ValueError(f"output '{out}' is a folder: give --out the name of a file")
    exports.check_suffix(out, name)
    if not kind.fixed_size and (width is not None or height is not None):
        raise ValueError(f"format '{name}' takes frames of any size: leave --width and --height out")
    if calibration_frames is not None and name != "openvino-int8":
        raise ValueError(f"format '{name}' is not calibrated: leave --calibration-frames out, or take openvino-int8")
    exports.require(name)
    info = ajna.load(model).info
    if info.format != "checkpoint":
        raise ValueError(f"model '{model}' is a {info.format} file already: give a checkpoint (.safetensors)")
    net, metadata = nn.load_checkpoint(info.path)
    size = (width or 320, height or 240)
    calibration, source = None, None
    if name == "openvino-int8":
        from ajna.exports import calibration as inputs
        from ajna.exports.graph import check_size

        check_size(net, *size)
        if calibration_frames is None:
            calibration, source = inputs.inputs_of_scenes(*size), f"{inputs.RENDERED} rendered scenes"
        else:
            calibration = inputs.inputs_of_frames(calibration_frames, *size)
            source = f"{len(calibration)} pairs of '{calibration_frames}'"
    with made_folder(out.parent):
        report = exports.export(out, net, metadata, name, *size, calibration)

    difference = report.difference
    summary = {
        "model": info.name,
        "format": name,
        "file": str(out),
        "files": [str(file) for file in report.files],
        "bytes": report.size_bytes,
        "calibration": source,
        "max_abs_difference": difference.raw,
        "share_of_largest_raw": difference.share,
        "limit": kind.limit,
        "max_abs_difference_flow_px": difference.flow_px,
        "mean_difference_flow_px": difference.flow_mean_px,
        "max_abs_difference_uncertainty": difference.uncertainty,
        "max_abs_difference_expected_error_px": difference.expected_error_px,
        "checked_sizes": list(difference.checked),
    }
    if as_json:
        typer.echo(json.dumps(summary))
        return
    files = " and ".join(str(file) for file in reversed(report.files))
    calibrated = f", calibrated on {source}" if source else ""
    typer.echo(
        f"wrote {files} ({report.size_bytes / 1e6:.1f} MB{calibrated}); max abs difference to the network "
        f"{difference.raw:.2g} raw ({difference.share:.1e} of the largest), {difference.flow_px:.2g} px of flow "
        f"(mean {difference.flow_mean_px:.2g}) at {', '.join(difference.checked)}"
    )
