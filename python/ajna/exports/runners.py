# SPDX-License-Identifier: MIT
"""Each exported file, opened by its own runtime: numpy in, numpy out. Nothing of Ajna is imported here.

So these few lines are also an example of how a program without Ajna runs the files, and the process that measures a
format's memory holds that format's runtime alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

OUTPUTS = ("raw", "flow", "uncertainty", "expected_error")
INPUT = "input"


def network_input(frame1: Array, frame2: Array) -> Array:
    """Two RGB frames uint8 [H, W, 3] -> float32 [1, 6, H, W] in [-1, 1]: x / 127.5 - 1, frame 1 before frame 2."""
    both = np.concatenate([frame1, frame2], axis=2).transpose(2, 0, 1)[None]
    values = np.ascontiguousarray(both, dtype=np.float32)
    values /= 127.5
    values -= 1.0
    return values


class Runner(Protocol):
    """An opened file."""

    def raw(self, x: Array) -> Array:
        """Network input float32 [N, 6, H, W] -> raw output [N, 4, H, W]."""

    def predict(self, frame1: Array, frame2: Array) -> tuple[Array, Array, Array]:
        """RGB uint8 [H, W, 3] -> flow, uncertainty and expected error, float32 [1, 2, H, W] each."""


class TorchScriptRunner:
    """A file of `ajna export --format torchscript` or `torchscript-bf16`: preprocessing is inside, any size."""

    def __init__(self, path: Path, threads: int | None) -> None:
        import torch

        _set_torch_threads(threads)
        self._torch = torch
        self._script = torch.jit.load(str(path))

    def raw(self, x: Array) -> Array:
        """See :class:`Runner`."""
        with self._torch.inference_mode():
            return self._script(self._torch.from_numpy(x)).numpy()

    def predict(self, frame1: Array, frame2: Array) -> tuple[Array, Array, Array]:
        """See :class:`Runner`."""
        first, second = (self._torch.from_numpy(frame).permute(2, 0, 1)[None] for frame in (frame1, frame2))
        with self._torch.inference_mode():
            flow, uncertainty, error = self._script.predict(first, second)
        return flow.numpy(), uncertainty.numpy(), error.numpy()


class _GraphRunner(ABC):
    """Files whose one function takes the network's input and gives OUTPUTS."""

    @abstractmethod
    def outputs(self, x: Array) -> tuple[Array, ...]:
        """Network input float32 [N, 6, H, W] -> the arrays named OUTPUTS."""

    def raw(self, x: Array) -> Array:
        """See :class:`Runner`."""
        return self.outputs(x)[0]

    def predict(self, frame1: Array, frame2: Array) -> tuple[Array, Array, Array]:
        """See :class:`Runner`."""
        _, flow, uncertainty, error = self.outputs(network_input(frame1, frame2))
        return flow, uncertainty, error


class OnnxRunner(_GraphRunner):
    """An ONNX file in ONNX Runtime on the CPU."""

    def __init__(self, path: Path, threads: int | None) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def outputs(self, x: Array) -> tuple[Array, ...]:
        """See :class:`_GraphRunner`."""
        return tuple(self._session.run(OUTPUTS, {INPUT: x}))


class OpenVinoRunner(_GraphRunner):
    """An OpenVINO file (.xml with the .bin beside it) on the CPU."""

    def __init__(self, path: Path, threads: int | None) -> None:
        import openvino

        # Without the first OpenVINO rounds to bfloat16 by itself where the processor has it.
        config: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
        if threads is not None:
            config["INFERENCE_NUM_THREADS"] = threads
        self._model = openvino.Core().compile_model(str(path), "CPU", config)

    def outputs(self, x: Array) -> tuple[Array, ...]:
        """See :class:`_GraphRunner`."""
        results = self._model(x)
        return tuple(results[name] for name in OUTPUTS)


class AotInductorRunner(_GraphRunner):
    """A package that AOTInductor compiled (.pt2)."""

    def __init__(self, path: Path, threads: int | None) -> None:
        import torch
        from torch._inductor import aoti_load_package

        _set_torch_threads(threads)
        self._torch = torch
        self._model = aoti_load_package(str(path))

    def outputs(self, x: Array) -> tuple[Array, ...]:
        """See :class:`_GraphRunner`."""
        with self._torch.inference_mode():
            return tuple(value.numpy() for value in self._model(self._torch.from_numpy(x)))


def _set_torch_threads(threads: int | None) -> None:
    """Set torch's threads for the whole process; None leaves them."""
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


_RUNNERS: dict[str, Any] = {
    "torchscript": TorchScriptRunner,
    "torchscript-bf16": TorchScriptRunner,
    "onnx": OnnxRunner,
    "openvino": OpenVinoRunner,
    "openvino-int8": OpenVinoRunner,
    "aotinductor": AotInductorRunner,
}


def open_exported(file_format: str, path: Path, threads: int | None = None) -> Runner:
    """Open a file of `ajna export`.

    Args:
        file_format: as given to `ajna export --format`.
        threads: of the runtime; None leaves its own choice (of torch for the whole process).

    Raises:
        KeyError: for an unknown format; ImportError where its runtime is missing; what the runtime raises otherwise.
    """
    return _RUNNERS[file_format](path, threads)
