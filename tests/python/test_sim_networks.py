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
from ajna.sim.methods.adapter import Network, PairNetwork, image_input
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
    import torch

    torch.jit.trace(torch.nn.Conv2d(6, 1, 1), torch.zeros(1, 6, 8, 8)).save(str(tmp_path / "six.pt"))
    with pytest.raises(ValueError, match="fails on an input"):
        Network(tmp_path / "six.pt")(np.zeros((3, 8, 8), np.float32))


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
    with pytest.raises(ValueError, match="fails on an input of \\(1, 6, 8, 8\\)"):
        Network(tmp_path / "whole.onnx")(np.zeros((6, 8, 8), np.float32))
    nan = Network(write_onnx(tmp_path / "nan.onnx", 0, bias=float("nan")))
    with pytest.raises(ValueError, match="not finite"):
        nan(np.zeros((3, 8, 8), np.float32))


# --- networks that compare two frames ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair_networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """TorchScript files: "flow": two frames to flow at half the size, by the brightness of each; "mask": where the
    first frame is brighter, from both in one input; "three": takes three frames."""
    import torch

    class Flow(torch.nn.Module):
        def forward(self, frame1: torch.Tensor, frame2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            small = torch.nn.functional.avg_pool2d(torch.cat([frame1[:, :1], frame2[:, :1]], 1), 2)
            return small * 10, small

    class Mask(torch.nn.Module):
        def forward(self, frames: torch.Tensor) -> torch.Tensor:
            return (frames[:, :1] > frames[:, 3:4]).float()

    class Three(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
            return a + b + c

    folder = tmp_path_factory.mktemp("pair")
    frame = torch.zeros(1, 3, 8, 8)
    torch.jit.trace(Flow(), (frame, frame)).save(str(folder / "flow.pt"))
    torch.jit.trace(Mask(), torch.zeros(1, 6, 8, 8)).save(str(folder / "mask.pt"))
    torch.jit.trace(Three(), (frame, frame, frame)).save(str(folder / "three.pt"))
    return {path.stem: path for path in folder.glob("*.pt")}


def plain(grey: int, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.full((*size, 3), grey, np.uint8)


def test_flow_network_of_the_user(pair_networks: dict[str, Path]) -> None:
    """Flow in pixels of the network's input becomes pixels of the frame; what leads there and back is measured."""
    field = PairNetwork(pair_networks["flow"])(plain(51), plain(102))
    assert field.flow.shape == field.uncertainty.shape == (24, 32, 2)
    assert np.allclose(field.flow, [2, 4])  # 10 x 51/255 to the right, 10 x 102/255 down
    assert np.allclose(field.uncertainty, [6, 6])  # 2 + 4 and 4 + 2: the way back was (4, 2)
    smaller = PairNetwork(pair_networks["flow"], size=(12, 8))(plain(51), plain(102))
    assert np.allclose(smaller.flow, [2 * 4, 4 * 2])  # four times as wide, twice as high
    for name in ("gapflyt-pwcnet", "gapflyt-flownet2", "gapflyt-spynet", "occmask-net"):
        assert make_method(name, pair_networks["flow"]).name == name


def test_flow_network_in_onnx(tmp_path: Path) -> None:
    """Two inputs, told apart by their order: flow = the red of frame 1, and of frame 2."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    pick = np.zeros((2, 6, 1, 1), np.float32)
    pick[0, 0], pick[1, 3] = 1, 1
    nodes = [
        helper.make_node("Concat", ["first", "second"], ["both"], axis=1),
        helper.make_node("Conv", ["both", "pick"], ["flow"]),
    ]
    frames = [helper.make_tensor_value_info(name, kind, [1, 3, "H", "W"]) for name in ("first", "second")]
    answer = helper.make_tensor_value_info("flow", kind, [1, 2, "H", "W"])
    graph = helper.make_graph(
        nodes, "flow", frames, [answer], [helper.make_tensor("pick", kind, pick.shape, pick.ravel())]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(tmp_path / "flow.onnx"))
    assert np.allclose(PairNetwork(tmp_path / "flow.onnx")(plain(51), plain(102)).flow, [0.2, 0.4])


def test_occlusion_by_networks(pair_networks: dict[str, Path]) -> None:
    """A mask is taken as it is, flow by its forward-backward distance; both lie on the newer frame."""
    dark, bright = plain(40, (48, 64)), plain(40, (48, 64))
    bright[12:36, 24:48] = 220
    square = bright[..., 0] == 220

    def mask(weights: Path) -> np.ndarray:
        method = make_method("occmask-net", weights)
        method.reset(TaskSetup("pile", CAMERA, 1.0, 0.25, 0))
        assert method._perception.mask(observation_of(dark), False) is None
        return method._perception.mask(observation_of(bright), False)

    by_mask = mask(pair_networks["mask"])
    assert (by_mask & square).sum() > 0.95 * (by_mask | square).sum()
    by_flow = mask(pair_networks["flow"])  # it never leads back, and least where it is bright
    assert by_flow is not None and by_flow[20:28, 32:40].all()


def test_errors_of_pair_networks(pair_networks: dict[str, Path], red_network: Path) -> None:
    with pytest.raises(ValueError, match="takes 3 inputs: expected two frames"):
        PairNetwork(pair_networks["three"])
    with pytest.raises(ValueError, match="takes 2 inputs: expected one"):
        Network(pair_networks["flow"])
    with pytest.raises(ValueError, match="gives an occlusion mask, but flow is needed"):
        PairNetwork(pair_networks["mask"])(plain(0), plain(9))
    with pytest.raises(ValueError, match="needs a network"):
        make_method("gapflyt-spynet")


def test_event_network_of_two_frames(tmp_path: Path) -> None:
    """It sees the event frame before the newest one, then the newest."""
    import torch

    class Older(torch.nn.Module):
        def forward(self, events: torch.Tensor) -> torch.Tensor:
            return events[:, 2:3]

    torch.jit.trace(Older(), torch.zeros(1, 6, 8, 8)).save(str(tmp_path / "older.pt"))
    method = make_method("evdodgenet-flow", tmp_path / "older.pt")
    method.reset(TaskSetup("dodge", CAMERA, 1.0, 0.25, 0))
    dark = np.full((48, 64, 3), 40, np.uint8)
    bright = dark.copy()
    bright[12:36, 24:48] = 220
    for _ in range(3):
        assert method._perception.mask(observation_of(dark), False) is None
    assert method._perception.mask(observation_of(bright), False) is None
    mask = method._perception.mask(observation_of(bright), False)
    square = bright[..., 0] == 220
    assert (mask & square).sum() > 0.95 * (mask | square).sum()
