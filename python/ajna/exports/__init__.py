# SPDX-License-Identifier: MIT
"""A model in formats that run without Ajna; each file is read back by its runtime and compared with the network.

`FORMATS` says what there is, :func:`export` writes one file, :mod:`ajna.exports.runners` opens it again. The packages
that a format needs (`pip install "ajna[export]"`) are imported when it is asked for and not before.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ajna.exports.runners import Array
    from ajna.exports.verify import Difference
    from ajna.nn import FlowNet

__all__ = ["FORMATS", "Format", "Report", "export", "missing", "require"]


@dataclass(frozen=True)
class Format:
    """One kind of file."""

    label: str
    suffixes: tuple[str, ...]  # of the file's name; the first is the usual one
    modules: tuple[str, ...]  # Python modules that writing and checking it need, named as pip names them
    fixed_size: bool  # whether H and W are fixed when it is written
    any_batch: bool
    limit: float  # a file is refused whose raw output differs by more than this share of the largest raw value
    on_noise: bool = True  # whether it is checked on noise, too; int8 has the range of frames only


# The shipped model differs by 0, 0.04, 2e-6, 3e-6, 0.2 (the worst pixel of an int8 file) and 3e-6, in this order.
FORMATS: dict[str, Format] = {
    "torchscript": Format("TorchScript float32", (".pt", ".torchscript"), (), False, True, 1e-5),
    "torchscript-bf16": Format("TorchScript bfloat16", (".pt", ".torchscript"), (), False, True, 0.2),
    "onnx": Format("ONNX float32", (".onnx",), ("onnx", "onnxscript", "onnxruntime"), True, True, 1e-4),
    "openvino": Format("OpenVINO float32", (".xml",), ("openvino",), True, True, 1e-4),
    "openvino-int8": Format("OpenVINO int8", (".xml",), ("openvino", "nncf"), True, True, 0.5, False),
    "aotinductor": Format("AOTInductor float32", (".pt2",), (), True, False, 1e-4),
}


@dataclass(frozen=True)
class Report:
    """A file that was written, read back and found to agree."""

    file_format: str
    files: tuple[Path, ...]
    difference: Difference

    @property
    def size_bytes(self) -> int:
        """Of all files together."""
        return sum(file.stat().st_size for file in self.files)


def missing(file_format: str) -> str | None:
    """What is not installed that the format needs, as a remedy ("pip install onnx"); None where all is there."""
    packages = [name for name in FORMATS[file_format].modules if find_spec(name) is None]
    if packages:
        return f"pip install {' '.join(packages)}"
    compilers = (os.environ.get("CXX", "g++").split()[-1], "clang++")  # CXX may begin with a launcher, e.g. ccache
    if file_format == "aotinductor" and not any(map(shutil.which, compilers)):
        return "apt-get install g++"
    return None


def require(file_format: str) -> None:
    """Raises ValueError, naming what to install, where the format cannot be written here."""
    remedy = missing(file_format)
    if remedy is not None:
        raise ValueError(f"format '{file_format}' needs software that is not here: {remedy}")


def export(
    path: Path,
    net: FlowNet,
    metadata: Mapping[str, Any],
    file_format: str,
    width: int = 320,
    height: int = 240,
    calibration: Sequence[Array] | None = None,
) -> Report:
    """Write ``net`` to ``path``; it appears under its name only after it was read back and agreed with ``net``.

    Args:
        path: the file; its folder exists. OpenVINO puts the weights beside it (.bin).
        net, metadata: as :func:`ajna.nn.load_checkpoint` returns them.
        file_format: a key of `FORMATS`.
        width, height: pixels; used where the format fixes the size.
        calibration: network inputs float32 [1, 6, height, width], for openvino-int8 alone.

    Raises:
        ValueError: an unknown format or ending of the name, software that is missing, a size or a network that does not
            fit, no calibration inputs, or a file that differs from ``net`` by more than the format's limit.
        RuntimeError: the file cannot be written.
    """
    if file_format not in FORMATS:
        raise ValueError(f"unknown export format '{file_format}': give one of {', '.join(FORMATS)}")
    kind = FORMATS[file_format]
    require(file_format)
    check_suffix(path, file_format)
    if (file_format == "openvino-int8") != (calibration is not None and len(calibration) > 0):
        raise ValueError(
            f"format '{file_format}' "
            + ("needs calibration frames" if file_format == "openvino-int8" else "takes no calibration frames")
        )
    from ajna.exports import graph
    from ajna.exports.verify import verify

    graph.check_network(net)
    if kind.fixed_size:
        graph.check_size(net, width, height)
    try:
        stage = Path(tempfile.mkdtemp(dir=path.parent, prefix=".ajna-"))
    except OSError as error:
        raise RuntimeError(f"folder '{path.parent}' is not writable ({error.strerror}): choose another") from error
    try:
        _write(stage / path.name, net, metadata, file_format, width, height, calibration)
        difference = verify(stage / path.name, net, metadata, file_format, width, height)
        files = sorted(stage.iterdir())  # .bin before .xml
        for file in files:
            os.replace(file, path.parent / file.name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    return Report(file_format, tuple(path.parent / file.name for file in files), difference)


def check_suffix(path: Path, file_format: str) -> None:
    """Raises ValueError unless the name ends as the format's readers expect."""
    suffixes = FORMATS[file_format].suffixes
    if path.suffix not in suffixes:
        raise ValueError(
            f"output '{path}': a file of format '{file_format}' ends in {' or '.join(suffixes)}; give for example "
            f"--out {path.with_suffix(suffixes[0]).name}"
        )


def _write(
    path: Path,
    net: FlowNet,
    metadata: Mapping[str, Any],
    file_format: str,
    width: int,
    height: int,
    calibration: Sequence[Array] | None,
) -> None:
    from ajna.exports import record

    if file_format == "torchscript":
        from ajna.nn import export_torchscript

        export_torchscript(path, net, metadata)
        return
    if file_format == "torchscript-bf16":
        from ajna.exports import torchscript_bf16

        torchscript_bf16.write(path, net, metadata)
        return
    from ajna.exports.graph import exportable

    graph = exportable(net, metadata)
    entries = record.record(net, metadata, file_format, (width, height), len(calibration or ()))
    if file_format == "onnx":
        from ajna.exports import onnx_file

        onnx_file.write(path, graph, width, height, entries)
    elif file_format == "aotinductor":
        from ajna.exports import aotinductor

        aotinductor.write(path, graph, width, height, entries)
    else:
        from ajna.exports import openvino_file

        openvino_file.write(path, graph, width, height, entries, calibration)
