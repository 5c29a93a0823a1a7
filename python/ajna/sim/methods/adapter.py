# SPDX-License-Identifier: MIT
"""Networks of the user's, from TorchScript or ONNX files: monocular depth, instance masks, event segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna.sim.methods.base import NOMINAL_DISTANCE_M, Map, Mask, largest_region, opened
from ajna.sim.methods.depth import DepthPerception
from ajna.sim.observation import Observation, TaskSetup

__all__ = ["InstanceMasks", "MonocularDepth", "Network", "image_input"]

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of ImageNet, which such networks are trained with
_STD = np.array([0.229, 0.224, 0.225], np.float32)


class Network:
    """A file that maps float32 [1, C, H, W] to one map, [1, 1, H, W] or [1, H, W] or [H, W].

    Args:
        path: ``.pt``, ``.pth``, ``.ts`` (TorchScript) or ``.onnx`` (run by OpenCV's dnn).
        size: (height, width) at which the network runs; None: the input's. The answer is scaled back.

    Raises:
        FileNotFoundError: no such file; ValueError: another kind of file, or one that cannot be loaded.
    """

    def __init__(self, path: str | Path, size: tuple[int, int] | None = None) -> None:
        self.path = Path(path)
        self.size = size
        if not self.path.is_file():
            raise FileNotFoundError(f"network file '{self.path}' does not exist: give a TorchScript or ONNX file")
        suffix = self.path.suffix.lower()
        if suffix not in (".pt", ".pth", ".ts", ".onnx"):
            raise ValueError(f"network '{self.path}' has the unknown extension '{suffix}': give .pt, .ts or .onnx")
        self._onnx = suffix == ".onnx"
        try:
            self._net: Any = self._load_onnx() if self._onnx else self._load_torchscript()
        except Exception as error:
            kind = "ONNX" if self._onnx else "TorchScript"
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise ValueError(f"network '{self.path}' cannot be loaded as {kind}: {first}") from error

    def _load_onnx(self) -> Any:
        import cv2

        return cv2.dnn.readNetFromONNX(str(self.path))

    def _load_torchscript(self) -> Any:
        import torch

        return torch.jit.load(str(self.path), map_location="cpu").eval()

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """One map float32 [H, W] for an input float32 [C, H, W].

        Raises:
            ValueError: the network fails on the input, or answers in another shape.
        """
        import cv2

        height, width = image.shape[1:]
        batch = image if self.size is None else np.stack([cv2.resize(c, self.size[::-1]) for c in image])
        try:
            answer = self._run(np.ascontiguousarray(batch[None], np.float32))
        except Exception as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[-1]
            raise ValueError(f"network '{self.path}' fails on an input of {batch.shape}: {first}") from error
        result = np.squeeze(answer)
        if result.ndim != 2:
            raise ValueError(f"network '{self.path}' answers with shape {answer.shape}: expected one map, [1, 1, H, W]")
        scaled = result if result.shape == (height, width) else cv2.resize(result, (width, height))
        return np.asarray(scaled, np.float32)

    def _run(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._onnx:
            self._net.setInput(batch)
            return np.asarray(self._net.forward(), np.float32)
        import torch

        with torch.inference_mode():
            answer = self._net(torch.from_numpy(batch))
            while isinstance(answer, (tuple, list)):
                answer = answer[0]
            return answer.float().numpy()


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

    def depth(self, observation: Observation) -> Map:
        raise ValueError("instance masks have no depth")

    def mask(self, observation: Observation, exploring: bool) -> Mask | None:
        mask = opened(self._network(image_input(observation.rgb)) > 0.5, 3, 5)
        if self._task == "dodge":
            return largest_region(mask, least_px=12)
        return mask if mask.any() else None
