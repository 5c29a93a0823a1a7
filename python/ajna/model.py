# SPDX-License-Identifier: MIT
"""Two frames in, flow and uncertainty out: :func:`load`, :class:`Model`, :class:`FlowField`."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ajna._core import EngineOptions, FlowEngine, ModelInfo, nearest_name

if TYPE_CHECKING:
    from ajna._core import ConformalFactors

#: A frame: RGB uint8 [H, W, 3], or the path of an image file.
FrameLike: TypeAlias = "NDArray[np.uint8] | str | os.PathLike[str]"

_WEIGHTS = Path(__file__).parent / "weights"
_WEIGHTS_NAME = re.compile(r"ajna-(?P<name>.+)-(?P<sha>[0-9a-f]{8})\.safetensors")
_MODEL_SUFFIXES = (".safetensors", ".pt", ".torchscript")


@dataclass(frozen=True, eq=False)
class FlowField:
    """Dense flow and its uncertainty on frame 1's grid; axes are (u, v), u to the right, v down.

    Attributes:
        flow: float32 [H, W, 2], pixels per frame interval: frame1(x) ~ frame2(x + flow(x)).
        uncertainty: float32 [H, W, 2], positive, grows with the expected error; in the unit of the loss.
        expected_error: float32 [H, W, 2], the error that the network expects of itself, pixels.
        timestamp_s: capture time of frame 2, seconds.
        conformal: how far intervals reach, where the model is calibrated (see :mod:`ajna.calibration`); else None.
    """

    flow: NDArray[np.float32]
    uncertainty: NDArray[np.float32]
    expected_error: NDArray[np.float32]
    timestamp_s: float = 0.0
    conformal: ConformalFactors | None = None

    def __post_init__(self) -> None:
        shape = self.flow.shape
        if len(shape) != 3 or shape[2] != 2 or self.uncertainty.shape != shape or self.expected_error.shape != shape:
            raise ValueError(
                f"flow {shape}, uncertainty {self.uncertainty.shape} and expected error {self.expected_error.shape}: "
                "give three arrays of one shape [H, W, 2]"
            )

    @property
    def width(self) -> int:
        """Pixels."""
        return self.flow.shape[1]

    @property
    def height(self) -> int:
        """Pixels."""
        return self.flow.shape[0]

    @cached_property
    def magnitude(self) -> NDArray[np.float32]:
        """float32 [H, W]: length of the flow, pixels."""
        return np.hypot(self.flow[..., 0], self.flow[..., 1])

    @cached_property
    def uncertainty_norm(self) -> NDArray[np.float32]:
        """float32 [H, W]: 2-norm of the uncertainty over the axes, the scalar map that tasks use."""
        return np.hypot(self.uncertainty[..., 0], self.uncertainty[..., 1])

    @cached_property
    def expected_error_norm(self) -> NDArray[np.float32]:
        """float32 [H, W]: 2-norm of the expected error over the axes, pixels."""
        return np.hypot(self.expected_error[..., 0], self.expected_error[..., 1])

    def interval(self, p: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Per axis the split-conformal interval that holds the true flow with probability ``p``.

        The probability is one over pixels of images like those that the model was calibrated on, on average over images
        and pixels; :mod:`ajna.calibration` says what that does and does not promise. Between the calibrated levels
        the width is interpolated linearly.

        Returns:
            (low, high): float32 [H, W, 2] each, pixels per frame interval.

        Raises:
            ValueError: the model is not calibrated, or not for such a ``p``; says how to calibrate it.
        """
        if self.conformal is None:
            raise ValueError(
                "flow intervals need a calibrated model: run `ajna calibrate MODEL --dataset NAME --root DIR --out "
                "NEW.safetensors` and load that file"
            )
        reach = np.asarray(self.conformal.at(p), dtype=np.float32) * self.expected_error
        return self.flow - reach, self.flow + reach

    def __repr__(self) -> str:
        return (
            f"FlowField({self.width}x{self.height}, mean flow {self.magnitude.mean():.3g} px, "
            f"mean uncertainty {self.uncertainty_norm.mean():.3g}, "
            f"mean expected error {self.expected_error_norm.mean():.3g} px)"
        )


class Model:
    """A loaded model; call it with two frames.

    The C++ engine runs it, with the GIL released: calls from several threads are safe. Make one by :func:`load`.

    Args:
        path: a checkpoint (.safetensors) or a TorchScript file (.pt, .torchscript) that Ajna wrote. TorchScript is a
            program: load it only from where you would run one.
        device: "cpu", "cuda" or "cuda:<index>".
        threads: torch's threads within one operation, for the whole process; None leaves them as they are.
        bfloat16: run the network in bfloat16: faster where the processor has it, at about two digits.

    Raises:
        FileNotFoundError: where there is no such file.
        ValueError: for a foreign or damaged file or an option out of range.
        RuntimeError: where the device is not there.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        device: str = "cpu",
        threads: int | None = None,
        bfloat16: bool = False,
    ) -> None:
        options = EngineOptions()
        options.device, options.bfloat16 = device, bfloat16
        if threads is not None:
            if threads < 1:
                raise ValueError(f"threads = {threads}: give at least 1, or None to leave torch's setting")
            options.threads = threads
        self._engine = FlowEngine(os.fspath(path), options)

    @property
    def info(self) -> ModelInfo:
        """Name, file, format, device, loss, parameters, provenance, and whether and on what it is calibrated."""
        return self._engine.info

    @property
    def engine(self) -> FlowEngine:
        """The C++ engine, for what takes one (:class:`ajna.tasks.NetworkSignal`)."""
        return self._engine

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the model's file, in hexadecimal."""
        return _sha256(Path(self.info.path))

    def __call__(self, frame1: FrameLike, frame2: FrameLike, timestamp_s: float = 0.0) -> FlowField:
        """Flow from frame 1 to frame 2, its uncertainty and the expected error, in pixels.

        Args:
            frame1, frame2: RGB uint8 [H, W, 3] of equal size (any), or paths of image files.
            timestamp_s: capture time of frame 2, seconds; passed through.

        Raises:
            ValueError: for frames that are not RGB uint8 or differ in size.
            RuntimeError: where the network gives NaN or the device fails.
        """
        return FlowField(*self._engine.infer(_frame(frame1, "frame 1"), _frame(frame2, "frame 2"), timestamp_s))

    def predict_batch(
        self, pairs: Sequence[tuple[FrameLike, FrameLike]], timestamps_s: Sequence[float] | None = None
    ) -> list[FlowField]:
        """The same for several pairs of one size at once; equal to one by one up to float32 rounding."""
        frames1 = [_frame(first, f"frame 1 of pair {index}") for index, (first, _) in enumerate(pairs)]
        frames2 = [_frame(second, f"frame 2 of pair {index}") for index, (_, second) in enumerate(pairs)]
        times = [0.0] * len(pairs) if timestamps_s is None else list(timestamps_s)
        return [FlowField(*field) for field in self._engine.infer_batch(frames1, frames2, times)]

    def warm_up(self, width: int, height: int, batch: int = 1, runs: int = 2) -> None:
        """Run on black frames: the first runs at a size are slow."""
        self._engine.warm_up(width, height, batch, runs)

    def __repr__(self) -> str:
        info = self.info
        return (
            f"Model('{info.name}', {info.format}, {info.parameters:,} parameters, {info.precision} on {info.device}, "
            f"file '{info.path}')"
        )


def models() -> dict[str, Path]:
    """The models shipped with the package: name -> checkpoint.

    Raises:
        ValueError: where two files carry one name.
    """
    found: dict[str, Path] = {}
    for path in sorted(_WEIGHTS.glob("*.safetensors")):
        if match := _WEIGHTS_NAME.fullmatch(path.name):
            if other := found.get(match["name"]):
                raise ValueError(f"'{other}' and '{path}' are both model '{match['name']}': remove one of them")
            found[match["name"]] = path
    return found


def load(
    name_or_path: str | os.PathLike[str] = "best",
    device: str = "cpu",
    threads: int | None = None,
    bfloat16: bool = False,
) -> Model:
    """Load a shipped model by its name, or a checkpoint or TorchScript file by its path; see :class:`Model`.

    Nothing is downloaded. A shipped file is checked against the hash in its name.

    Raises:
        FileNotFoundError: where there is no such file.
        ValueError: for an unknown name (the message lists those known) and for a foreign or damaged file.
        RuntimeError: where the device is not there.

    Example:
        >>> model = ajna.load()
        >>> field = model("frame1.png", "frame2.png")
        >>> field.flow.shape
        (480, 640, 2)
    """
    return Model(_resolve(name_or_path), device=device, threads=threads, bfloat16=bfloat16)


def _resolve(name_or_path: str | os.PathLike[str]) -> Path:
    if not isinstance(name_or_path, str):
        return Path(name_or_path)
    shipped = models()
    if path := shipped.get(name_or_path):
        stored = path.stem.rpartition("-")[2]
        if (actual := _sha256(path)[:8]) != stored:
            raise ValueError(f"model file '{path}' is damaged (its hash is {actual}, not {stored}): install ajna again")
        return path
    if name_or_path.endswith(_MODEL_SUFFIXES) or os.sep in name_or_path or os.path.exists(name_or_path):
        return Path(name_or_path)
    near = nearest_name(name_or_path, list(shipped))
    hint = f", did you mean '{near}'?" if near else "."
    known = ", ".join(shipped) or "none, as this build ships no models"
    raise ValueError(f"unknown model '{name_or_path}'{hint} Known: {known}; or give the path of a model file")


def checkpoint_path(name_or_path: str | os.PathLike[str]) -> Path:
    """The file of a shipped model or of a checkpoint, for what needs its network and not the engine.

    Raises:
        ValueError: for an unknown name, and for a TorchScript file, whose network is sealed.
    """
    path = _resolve(name_or_path)
    if path.suffix != ".safetensors":
        raise ValueError(f"model '{path}' is not a checkpoint (.safetensors): give the one it was exported from")
    return path


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _frame(frame: Any, name: str) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] with packed pixels, or one sentence on what is wrong and how to change it."""
    if isinstance(frame, (str, os.PathLike)):
        from ajna import io  # needs OpenCV, which arrays do without

        return io.read_image(frame)
    if not isinstance(frame, np.ndarray):
        raise TypeError(f"{name} is a {type(frame).__name__}: give a numpy array [H, W, 3] of uint8 RGB or a path")
    if frame.ndim == 2 or (frame.ndim == 3 and frame.shape[2] == 1):
        raise ValueError(f"{name} is grey {frame.shape}: give RGB [H, W, 3], e.g. np.dstack([image] * 3)")
    if frame.ndim == 3 and frame.shape[2] == 4:
        raise ValueError(f"{name} has 4 channels {frame.shape}: give RGB without alpha, e.g. image[..., :3]")
    if frame.ndim == 3 and frame.shape[0] == 3 and frame.shape[2] != 3:
        raise ValueError(f"{name} is [3, H, W] {frame.shape}: give [H, W, 3], e.g. image.transpose(1, 2, 0)")
    if frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(f"{name} has shape {frame.shape}: give RGB [H, W, 3]")
    if frame.dtype != np.uint8:
        broken = np.issubdtype(frame.dtype, np.floating) and not np.isfinite(frame).all()
        raise ValueError(
            f"{name} is {frame.dtype}{' and holds NaN or infinite values' if broken else ''}: give uint8 with values "
            "0 to 255, e.g. (255 * image).round().astype(np.uint8) for values from 0 to 1"
        )
    packed = frame.strides[2] == 1 and frame.strides[1] == 3 and frame.strides[0] >= 3 * frame.shape[1]
    return frame if packed else np.ascontiguousarray(frame)
