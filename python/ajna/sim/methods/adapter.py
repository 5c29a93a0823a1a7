# SPDX-License-Identifier: MIT
"""Networks of the user's, from TorchScript or ONNX files: flow, monocular depth, instance masks, event segmentation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna.baselines import BaselineField, forward_backward_difference
from ajna.sim.methods.base import NOMINAL_DISTANCE_M, Mask, largest_region, opened
from ajna.sim.methods.depth import DepthPerception
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["InstanceMasks", "MonocularDepth", "Network", "PairNetwork", "image_input"]

Map = NDArray[np.float32]
_Run = Callable[[Sequence[Map]], Any]

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of ImageNet, which such networks are trained with
_STD = np.array([0.229, 0.224, 0.225], np.float32)


class _NetworkFile:
    """A TorchScript (``.pt``, ``.pth``, ``.ts``) or ONNX file, run on the CPU.

    Raises:
        FileNotFoundError: no such file; ValueError: another kind of file, or one that cannot be loaded.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"network file '{self.path}' does not exist: give a TorchScript or ONNX file")
        suffix = self.path.suffix.lower()
        if suffix not in (".pt", ".pth", ".ts", ".onnx"):
            raise ValueError(f"network '{self.path}' has the unknown extension '{suffix}': give .pt, .ts or .onnx")
        kind, load = ("ONNX", self._load_onnx) if suffix == ".onnx" else ("TorchScript", self._load_torchscript)
        try:
            self._run, self.inputs = load()
        except ImportError:
            raise
        except Exception as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise ValueError(f"network '{self.path}' cannot be loaded as {kind}: {first}") from error

    def _load_onnx(self) -> tuple[_Run, int]:
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(
                f"'{self.path}' is an ONNX file, which needs onnxruntime: install it with `pip install onnxruntime`"
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # trials run side by side
        options.log_severity_level = 4  # what is wrong is said by the exception
        session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        names = [entry.name for entry in session.get_inputs()]
        return lambda arrays: session.run(None, dict(zip(names, arrays, strict=True)))[0], len(names)

    def _load_torchscript(self) -> tuple[_Run, int]:
        import torch

        module = torch.jit.load(str(self.path), map_location="cpu").eval()
        needed = [entry for entry in module.forward.schema.arguments[1:] if not entry.has_default_value()]

        def run(arrays: Sequence[Map]) -> Any:
            with torch.inference_mode():
                answer = module(*(torch.from_numpy(array) for array in arrays))
                while isinstance(answer, (tuple, list)):
                    answer = answer[0]
                return answer.float().numpy()

        return run, len(needed)

    def run(self, arrays: Sequence[Map]) -> Map:
        """The first answer as float32, for inputs float32 [1, C, H, W].

        Raises:
            ValueError: the network fails on the inputs, or gives a number that is not finite.
        """
        try:
            answer = np.asarray(self._run([np.ascontiguousarray(array, np.float32) for array in arrays]), np.float32)
        except Exception as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[-1]
            shapes = " and ".join(str(array.shape) for array in arrays)
            raise ValueError(f"network '{self.path}' fails on an input of {shapes}: {first}") from error
        if not np.isfinite(answer).all():
            raise ValueError(f"network '{self.path}' answers with numbers that are not finite")
        return answer


def _resized(image: Map, size: tuple[int, int]) -> Map:
    """[C, H, W] at (height, width), bilinear."""
    import cv2

    if image.shape[1:] == size:
        return image
    return np.stack([cv2.resize(channel, size[::-1]) for channel in image]).astype(np.float32)


class Network:
    """A file that maps float32 [1, C, H, W] to one map, [1, 1, H, W] or [1, H, W] or [H, W].

    Args:
        path: ``.pt``, ``.pth``, ``.ts`` (TorchScript) or ``.onnx`` (run by ONNX Runtime).
        size: (height, width) at which the network runs; None: the input's. The answer is scaled back.

    Raises:
        FileNotFoundError: no such file; ValueError: another kind of file, one that cannot be loaded, or one that takes
            more than one input; ImportError: an ONNX file without ONNX Runtime.
    """

    def __init__(self, path: str | Path, size: tuple[int, int] | None = None) -> None:
        self._file = _NetworkFile(path)
        self.path, self.size = self._file.path, size
        if self._file.inputs != 1:
            raise ValueError(f"network '{self.path}' takes {self._file.inputs} inputs: expected one, [1, C, H, W]")

    def __call__(self, image: Map) -> Map:
        """One map float32 [H, W] for an input float32 [C, H, W].

        Raises:
            ValueError: the network fails on the input, or answers in another shape or with NaN.
        """
        size = image.shape[1], image.shape[2]
        answer = self._file.run([_resized(image, self.size or size)[None]])
        result = np.squeeze(answer)
        if result.ndim != 2:
            raise ValueError(f"network '{self.path}' answers with shape {answer.shape}: expected one map, [1, 1, H, W]")
        return _resized(result[None], size)[0]


class PairNetwork:
    """A file that compares two frames: optical flow, or directly an occlusion mask.

    It takes the frames, RGB in 0 to 1, as two inputs float32 [1, 3, H, W] or as one [1, 6, H, W], and gives either flow
    [1, 2, h, w] (to the right, downwards; pixels of its *input*, whatever h and w are) or the probability that a pixel
    of the first frame is not seen in the second, [1, 1, h, w]. Another normalisation belongs into the file.

    Args:
        path, size: as for :class:`Network`.

    Raises:
        As :class:`Network`; ValueError also for a file with another number of inputs than one or two.
    """

    def __init__(self, path: str | Path, size: tuple[int, int] | None = None) -> None:
        self._file = _NetworkFile(path)
        self.path, self.size = self._file.path, size
        if self._file.inputs not in (1, 2):
            raise ValueError(
                f"network '{self.path}' takes {self._file.inputs} inputs: expected two frames [1, 3, H, W], or both as "
                "one [1, 6, H, W]"
            )

    def answer(self, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8]) -> Map:
        """Flow float32 [2, H, W] in pixels of the frames, or an occlusion mask [1, H, W]; frames uint8 [H, W, 3].

        Raises:
            ValueError: the network fails on the frames, or answers in another shape or with NaN.
        """
        size = frame1.shape[0], frame1.shape[1]
        run_at = self.size or size
        frames = [
            _resized((frame / np.float32(255)).astype(np.float32).transpose(2, 0, 1), run_at)[None]
            for frame in (frame1, frame2)
        ]
        answer = self._file.run(frames if self._file.inputs == 2 else [np.concatenate(frames, 1)])
        if answer.ndim != 4 or answer.shape[0] != 1 or answer.shape[1] not in (1, 2):
            raise ValueError(
                f"network '{self.path}' answers with shape {answer.shape}: expected flow [1, 2, H, W] or an occlusion "
                "mask [1, 1, H, W]"
            )
        result = _resized(answer[0], size)
        if len(result) == 2:
            result = result * np.array([size[1] / run_at[1], size[0] / run_at[0]], np.float32)[:, None, None]
        return result

    def __call__(self, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8], /) -> BaselineField:
        """Flow and its forward-backward distance: a flow method (two runs).

        Raises:
            ValueError: as :meth:`answer`; also where the network gives no flow.
        """
        return self.with_distance(self.answer(frame1, frame2), frame1, frame2)

    def with_distance(self, forward: Map, frame1: NDArray[np.uint8], frame2: NDArray[np.uint8]) -> BaselineField:
        """The flow [2, H, W] from frame 1 to 2, and its distance from the flow back (one run).

        Raises:
            ValueError: as :meth:`answer`; also for an occlusion mask.
        """
        if len(forward) != 2:
            raise ValueError(f"network '{self.path}' gives an occlusion mask, but flow is needed here: [1, 2, H, W]")
        there, back = forward.transpose(1, 2, 0), self.answer(frame2, frame1).transpose(1, 2, 0)
        return BaselineField(there, np.abs(forward_backward_difference(there, back)))


def image_input(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """RGB uint8 [H, W, 3] as float32 [3, H, W], normalised as for ImageNet."""
    normalized = (rgb.astype(np.float32) / 255 - _MEAN) / _STD
    return normalized.transpose(2, 0, 1).astype(np.float32)


class _AsDepth:
    """A sensor for :class:`DepthPerception` from a network's relative inverse depth."""

    needs = frozenset({"rgb"})
    noise = 0.10
    open_px = 3

    def __init__(self, network: Network) -> None:
        self._network = network

    def reset(self, setup: TaskSetup) -> None: ...

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Depth up to an unknown scale: here the nearest tenth of the picture is put at the nominal distance."""
        inverse = self._network(image_input(observation.rgb))
        near = float(np.quantile(inverse, 0.9))
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = NOMINAL_DISTANCE_M * near / inverse
        return np.where(inverse > 0.02 * near, depth, np.inf).astype(np.float32)


class MonocularDepth(DepthPerception):
    """Monocular networks that give relative inverse depth (MiDaS): scaled, then used like depth."""

    def __init__(self, network: Network) -> None:
        super().__init__(lambda: _AsDepth(network))


class InstanceMasks:
    """Networks that give the probability of belonging to an object (a Mask R-CNN or PointRend reduced to one map)."""

    tasks = frozenset({"dodge", "pile"})
    needs = frozenset({"rgb"})

    def __init__(self, network: Network) -> None:
        self._network = network

    def reset(self, setup: TaskSetup) -> None:
        self._task = setup.task

    def depth(self, observation: Observation) -> NDArray[np.floating]:
        raise ValueError("instance masks have no depth")

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        mask = opened(self._network(image_input(observation.rgb)) > 0.5, 3, 5)
        if self._task == "dodge":
            return largest_region(mask, least_px=12)
        return mask if mask.any() else None
