# SPDX-License-Identifier: MIT
"""`ajna export` beyond TorchScript: every file, in its own runtime, gives what the network gives."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import ajna
from ajna import exports, io, nn
from ajna.cli import main
from ajna.exports import calibration, graph, runners
from ajna.losses import UncertaintyLoss

WIDTH, HEIGHT = 64, 48
COMPILED = pytest.param("aotinductor", marks=pytest.mark.slow)
GRAPH_FORMATS = ("onnx", "openvino", "openvino-int8", COMPILED)  # network input in, four named outputs

Pair = tuple[np.ndarray, np.ndarray]
Model = tuple[nn.FlowNet, dict[str, Any]]


def random_network(**options: Any) -> nn.FlowNet:
    """Of width 4, in eval mode, with random statistics in its batch normalisation: folding must use them."""
    torch.manual_seed(0)
    net = nn.FlowNet(width=4, **options).eval()
    with torch.no_grad():
        for name, buffer in net.named_buffers():
            if name.endswith("running_mean"):
                buffer.normal_(0, 0.2)
            elif name.endswith("running_var"):
                buffer.uniform_(0.5, 2.0)
    return net


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exports") / "random.safetensors"
    provenance = {"data": "none"}
    nn.save_checkpoint(path, random_network(), "random", UncertaintyLoss(), flow_scale=3.0, provenance=provenance)
    return path


@pytest.fixture(scope="module")
def model(checkpoint: Path) -> Model:
    return nn.load_checkpoint(checkpoint)


def exported(file_format: str, folder: Path, model: Model) -> exports.Report:
    """The file, or a skip that names what is missing."""
    remedy = exports.missing(file_format)
    if remedy is not None:
        pytest.skip(f"format '{file_format}' needs {remedy}")
    inputs = calibration.inputs_of_scenes(WIDTH, HEIGHT, 4) if file_format == "openvino-int8" else None
    path = folder / f"net{exports.FORMATS[file_format].suffixes[0]}"
    return exports.export(path, *model, file_format, WIDTH, HEIGHT, inputs)


def metadata_of(file_format: str, path: Path) -> dict[str, str]:
    """What the file says about itself, read by the format's own library."""
    if file_format == "onnx":
        import onnx

        return {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    if file_format == "aotinductor":
        from torch._inductor import aoti_load_package

        return aoti_load_package(str(path)).get_metadata()
    import openvino

    read = openvino.Core().read_model(path)
    return {f"ajna.{key}": value for key, value in read.get_rt_info("ajna").value.items()}


# --- the graph -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options", [{}, {"skip_connections": True}, {"scale_heads": True}, {"correlation_radius": 2}], ids=str
)
def test_the_graph_is_the_network_at_any_size_and_batch(options: dict[str, Any], model: Model) -> None:
    net = random_network(**options)
    recorded = graph.exportable(net, model[1])
    assert not [node for node in recorded.network.graph.nodes if "batch_norm" in str(node.target)]
    for shape in ((1, 6, 32, 32), (3, 6, 48, 80)):
        x = 2 * torch.rand(shape) - 1
        with torch.no_grad():
            expected = net(x)
            uncertainty, error = model[1]["table"].evaluate(expected[:, 2:])
            given = recorded(x)
        for mine, theirs in zip((expected, 3 * expected[:, :2], uncertainty, 3 * error), given, strict=True):
            torch.testing.assert_close(theirs, mine, rtol=1e-4, atol=1e-5)


def test_recording_leaves_the_network_as_it_was(model: Model) -> None:
    net = random_network()
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    graph.exportable(net, model[1], torch.bfloat16)
    for name, tensor in net.state_dict().items():
        assert tensor.dtype == before[name].dtype and torch.equal(tensor, before[name]), name


def test_networks_that_are_not_exported(model: Model, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="training mode"):
        exports.export(tmp_path / "a.pt", random_network().train(), model[1], "torchscript-bf16")
    with pytest.raises(ValueError, match="from 6 to 2 channels"):
        exports.export(tmp_path / "a.pt", nn.FlowNet(width=4, out_channels=2).eval(), model[1], "torchscript-bf16")
    assert not list(tmp_path.iterdir())


# --- the files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file_format", GRAPH_FORMATS)
def test_files_give_what_the_network_gives(file_format: str, tmp_path: Path, model: Model) -> None:
    net, metadata = model
    report = exported(file_format, tmp_path, model)
    kind = exports.FORMATS[file_format]
    assert sorted(tmp_path.iterdir()) == sorted(report.files) and report.size_bytes > 0
    assert 0 <= report.difference.share <= kind.limit

    path = next(file for file in report.files if file.suffix == kind.suffixes[0])
    runner = runners.open_exported(file_format, path, threads=1)
    scenes = np.concatenate(calibration.inputs_of_scenes(WIDTH, HEIGHT, 3))
    for x in (scenes[:1], scenes) if kind.any_batch else (scenes[:1],):
        with torch.no_grad():
            expected = net(torch.from_numpy(x))
        raw, flow, uncertainty, error = runner.outputs(x)
        # As large a difference as the format's limit, and for all but int8 far below it.
        np.testing.assert_allclose(raw, expected, atol=kind.limit * float(expected.abs().max()), rtol=0)
        # The maps follow from this very raw output, in pixels and by the checkpoint's table.
        np.testing.assert_allclose(flow, 3 * raw[:, :2], rtol=1e-5, atol=1e-6)
        table = metadata["table"].evaluate(torch.from_numpy(raw[:, 2:].copy()))
        np.testing.assert_allclose(uncertainty, table[0], rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(error, 3 * table[1], rtol=1e-3, atol=1e-5)

    entries = metadata_of(file_format, path)
    assert entries["ajna.name"] == "random" and float(entries["ajna.flow_scale"]) == 3.0
    assert (entries["ajna.width"], entries["ajna.height"]) == (str(WIDTH), str(HEIGHT))
    assert json.loads(entries["ajna.provenance"]) == {"data": "none"} and "127.5" in entries["ajna.input"]


def test_bfloat16_script_runs_in_the_engine(tmp_path: Path, checkpoint: Path, model: Model, frame_pair: Pair) -> None:
    report = exported("torchscript-bf16", tmp_path, model)
    small, large = report.size_bytes, checkpoint.stat().st_size
    assert small < large
    loaded = ajna.load(report.files[0])
    assert (loaded.info.name, loaded.info.format, loaded.info.flow_scale) == ("random", "torchscript", 3.0)
    assert loaded.info.precision == "bfloat16" and "bfloat16" in repr(loaded)
    assert ajna.load(checkpoint).info.precision == "float32"
    first, second = (frame[:-3, :-5] for frame in frame_pair)  # a size that must be padded
    mine, theirs = ajna.load(checkpoint)(first, second), loaded(first, second)
    for name in ("flow", "uncertainty", "expected_error"):
        expected = getattr(mine, name)
        difference = np.abs(expected - getattr(theirs, name)).max()
        assert 0 < difference < 0.1 * np.abs(expected).max(), name


def test_a_file_that_differs_is_not_kept(tmp_path: Path, model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    strict = exports.Format(**{**vars(exports.FORMATS["torchscript-bf16"]), "limit": 1e-7})
    monkeypatch.setitem(exports.FORMATS, "torchscript-bf16", strict)
    with pytest.raises(ValueError, match="more than the limit of 1e-07: it is not kept"):
        exports.export(tmp_path / "a.pt", *model, "torchscript-bf16")
    assert not list(tmp_path.iterdir())


def test_runners_need_nothing_of_ajna(tmp_path: Path, model: Model, frame_pair: Pair) -> None:
    (path,) = exported("onnx", tmp_path, model).files
    np.save(tmp_path / "frames.npy", np.stack(frame_pair))
    code = (
        "import importlib.util, sys, numpy, pathlib\n"
        "spec = importlib.util.spec_from_file_location('runners', sys.argv[1])\n"
        "runners = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(runners)\n"
        "flow = runners.open_exported('onnx', pathlib.Path(sys.argv[2])).predict(*numpy.load(sys.argv[3]))[0]\n"
        "assert not {'ajna', 'torch'} & set(sys.modules)\n"
        "numpy.save(sys.argv[4], flow)\n"
    )
    files = [runners.__file__, path, tmp_path / "frames.npy", tmp_path / "flow.npy"]
    subprocess.run([sys.executable, "-c", code, *map(str, files)], check=True, cwd=tmp_path)
    x = nn.network_input(*(torch.from_numpy(frame).permute(2, 0, 1)[None] for frame in frame_pair))
    with torch.no_grad():
        expected = 3 * model[0](x)[:, :2]
    np.testing.assert_allclose(np.load(tmp_path / "flow.npy"), expected, rtol=1e-3, atol=1e-4)


# --- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def refused(checkpoint: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs `ajna export`, expects exit code 2, one sentence and no file; the sentence."""

    def run(file_format: str, name: str, *arguments: object) -> str:
        command = ["export", "--model", checkpoint, "--format", file_format, "--out", tmp_path / name, *arguments]
        assert main([str(argument) for argument in command]) == 2
        output, error = capfd.readouterr()
        assert output == "" and error.startswith("ajna: ") and error.count("\n") == 1, error
        assert not (tmp_path / name).exists()
        return error

    return run


def test_the_command_refuses(refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "ends in .onnx" in refused("onnx", "net.pt")
    assert "any size" in refused("torchscript-bf16", "net.pt", "--width", 64)
    assert "not calibrated" in refused("onnx", "net.onnx", "--calibration-frames", tmp_path)
    monkeypatch.setattr(exports, "find_spec", lambda name: None)
    assert "pip install onnx onnxscript onnxruntime" in refused("onnx", "net.onnx")
    assert "pip install openvino nncf" in refused("openvino-int8", "net.xml")
    monkeypatch.setattr(exports, "find_spec", lambda name: name)
    assert "for example 64x48," in refused("onnx", "net.onnx", "--width", 60, "--height", 50)
    (tmp_path / "one").mkdir()
    io.write_image(tmp_path / "one" / "0.png", np.zeros((48, 64, 3), np.uint8))
    assert "at least two" in refused("openvino-int8", "net.xml", "--calibration-frames", tmp_path / "one")
    assert "nowhere" in refused("openvino-int8", "net.xml", "--calibration-frames", tmp_path / "nowhere")


def test_the_command_prints_the_difference(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "net.pt"
    command = ["export", "--model", str(checkpoint), "--format", "torchscript-bf16", "--out", str(out)]
    assert main(command) == 0
    assert "max abs difference to the network 0.0" in capsys.readouterr().out
    assert main([*command, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["max_abs_difference"] > 0 and summary["share_of_largest_raw"] < summary["limit"]
    assert summary["bytes"] == out.stat().st_size and "57x33" in summary["checked_sizes"]
    assert [file.name for file in out.parent.iterdir()] == ["net.pt"]


def test_calibration_inputs_are_successive_frames(tmp_path: Path, frame_pair: Pair) -> None:
    for number in range(5):
        io.write_image(tmp_path / f"{number}.png", np.roll(frame_pair[0], number, axis=1))
    inputs = calibration.inputs_of_frames(tmp_path, WIDTH, HEIGHT)
    assert len(inputs) == 4 and all(x.shape == (1, 6, HEIGHT, WIDTH) and x.dtype == np.float32 for x in inputs)
    np.testing.assert_array_equal(inputs[0][:, 3:], inputs[1][:, :3])
    tensors = [torch.from_numpy(np.roll(frame_pair[0], shift, 1)).permute(2, 0, 1)[None] for shift in (0, 1)]
    np.testing.assert_allclose(inputs[0], nn.network_input(*tensors), atol=1e-6)
    assert len(calibration.inputs_of_frames(tmp_path, WIDTH, HEIGHT, max_pairs=2)) == 2
