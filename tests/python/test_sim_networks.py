# SPDX-License-Identifier: MIT
"""The simulator's methods that run a network of the user's, from TorchScript and ONNX files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from ajna.sim import CameraModel, make_method
from ajna.sim.methods.adapter import Network, image_input
from ajna.sim.observation import TaskSetup

CAMERA = CameraModel(width=64, height=48)


@pytest.fixture(scope="module")
def red_network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TorchScript file that answers with the red channel."""
    import torch

    class Red(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return x[:, :1]

    path = tmp_path_factory.mktemp("net") / "red.pt"
    torch.jit.trace(Red(), torch.zeros(1, 3, 8, 8)).save(str(path))
    return path


def test_network_of_the_user(red_network: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    network = Network(red_network)
    assert np.allclose(network(image_input(image)), image_input(image)[0])
    assert Network(red_network, size=(12, 16))(image_input(image)).shape == (24, 32)
    for name in ("midas", "midas-s", "mask-rcnn", "pointrend", "evdodgenet"):
        assert make_method(name, red_network).name == name


def test_network_errors(tmp_path: Path, red_network: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Network(tmp_path / "none.pt")
    for name in ("broken.pt", "broken.onnx"):
        (tmp_path / name).write_bytes(b"not a network")
        with pytest.raises(ValueError, match="cannot be loaded"):
            Network(tmp_path / name)
    (tmp_path / "net.bin").write_bytes(b"")
    with pytest.raises(ValueError, match="unknown extension"):
        Network(tmp_path / "net.bin")
    network = Network(red_network)
    network._net = lambda batch: 1 / 0
    with pytest.raises(ValueError, match="fails on an input"):
        network(np.zeros((3, 8, 8), np.float32))


def write_onnx(path: Path, channel: int, gain: float = 1.0, bias: float = 0.0, end: str | None = None) -> Path:
    """An ONNX file that answers with one channel, scaled.

    ``end``: "half": at half the size, by averaging 2x2; "flat": as a vector.
    """
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    weights = np.zeros((1, 3, 1, 1), np.float32)
    weights[0, channel] = gain
    nodes = [helper.make_node("Conv", ["image", "weights", "bias"], ["scaled" if end else "map"])]
    if end == "half":
        nodes.append(helper.make_node("AveragePool", ["scaled"], ["map"], kernel_shape=[2, 2], strides=[2, 2]))
    if end == "flat":
        nodes.append(helper.make_node("Flatten", ["scaled"], ["map"], axis=0))
    graph = helper.make_graph(
        nodes,
        "channel",
        [helper.make_tensor_value_info("image", kind, [1, 3, "H", "W"])],
        [helper.make_tensor_value_info("map", kind, [1, "n"] if end == "flat" else [1, 1, "h", "w"])],
        [
            helper.make_tensor("weights", kind, weights.shape, weights.ravel()),
            helper.make_tensor("bias", kind, [1], [bias]),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def observation_of(rgb: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(rgb=rgb, frame=SimpleNamespace(camera=CAMERA))


def test_onnx_and_torchscript_agree(tmp_path: Path, red_network: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    network = Network(write_onnx(tmp_path / "red.onnx", 0))
    assert np.allclose(network(image_input(image)), Network(red_network)(image_input(image)), atol=1e-6)
    assert np.allclose(network(image_input(image[:24])), image_input(image)[0, :24], atol=1e-6)  # another size
    sized = Network(tmp_path / "red.onnx", size=(24, 32))
    assert np.allclose(sized(image_input(image)), Network(red_network, (24, 32))(image_input(image)), atol=1e-5)
    for name in ("midas", "midas-s", "mask-rcnn", "pointrend", "evdodgenet"):
        assert make_method(name, tmp_path / "red.onnx").name == name


def test_onnx_that_answers_at_half_the_size(tmp_path: Path) -> None:
    ramp = np.repeat(np.linspace(0, 255, 64)[None, :, None], 48, 0).repeat(3, 2).astype(np.uint8)
    answer = Network(write_onnx(tmp_path / "half.onnx", 1, end="half"))(image_input(ramp))
    assert answer.shape == (48, 64)
    assert np.abs(answer - image_input(ramp)[1]).max() < 0.06


def test_onnx_as_depth_masks_and_event_network(tmp_path: Path) -> None:
    """A bright square is near, an object, and a place of events, to three networks that look at brightness."""
    dark = np.full((48, 64, 3), 40, np.uint8)
    bright = dark.copy()
    bright[12:36, 24:48] = 220
    square = bright[..., 0] == 220
    weights = write_onnx(tmp_path / "green.onnx", 1, bias=2.5)  # positive everywhere: an inverse depth

    def started(name: str, task: str):
        method = make_method(name, weights)
        method.reset(TaskSetup(task, CAMERA, 1.0, 0.25, 0))
        return method._perception

    depth = started("midas", "navigate").depth(observation_of(bright))
    assert depth[square].max() < 0.6 * depth[~square].min()

    weights = write_onnx(tmp_path / "probability.onnx", 1, gain=0.3, bias=0.3)
    for name in ("mask-rcnn", "pointrend"):
        mask = started(name, "pile").mask(observation_of(bright), False)
        assert (mask & square).sum() > 0.95 * (mask | square).sum()
        assert started(name, "dodge").mask(observation_of(dark), False) is None

    weights = write_onnx(tmp_path / "events.onnx", 0)  # positive events
    network = started("evdodgenet", "dodge")
    for _ in range(3):
        assert network.mask(observation_of(dark), False) is None
    mask = network.mask(observation_of(bright), False)
    assert (mask & square).sum() > 0.95 * (mask | square).sum()


def test_onnx_errors_are_sentences(tmp_path: Path) -> None:
    (tmp_path / "cut.onnx").write_bytes(write_onnx(tmp_path / "whole.onnx", 0).read_bytes()[:60])
    with pytest.raises(ValueError, match="cannot be loaded as ONNX") as caught:
        Network(tmp_path / "cut.onnx")
    assert "\n" not in str(caught.value)
    flat = Network(write_onnx(tmp_path / "flat.onnx", 0, end="flat"))
    with pytest.raises(ValueError, match="expected one map"):
        flat(np.zeros((3, 8, 8), np.float32))
