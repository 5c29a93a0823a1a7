# SPDX-License-Identifier: MIT
"""ajna.load, ajna.Model and ajna.FlowField: what they give and what they refuse."""

from __future__ import annotations

import gc
import hashlib
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import ajna
import ajna.model

Pair = tuple[NDArray[np.uint8], NDArray[np.uint8]]


@pytest.fixture(scope="module")
def model(tiny_checkpoint: Path) -> ajna.Model:
    return ajna.load(tiny_checkpoint)


def test_field_has_the_documented_shapes_and_dtypes(model: ajna.Model, frame_pair: Pair) -> None:
    field = model(*frame_pair, timestamp_s=1.5)
    for plane in (field.flow, field.uncertainty, field.expected_error):
        assert plane.shape == (48, 64, 2) and plane.dtype == np.float32 and plane.flags.c_contiguous
    assert (field.width, field.height, field.timestamp_s) == (64, 48, 1.5)
    assert (field.uncertainty > 0).all() and (field.expected_error > 0).all()
    np.testing.assert_allclose(field.magnitude, np.linalg.norm(field.flow, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(field.uncertainty_norm, np.linalg.norm(field.uncertainty, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(field.expected_error_norm, np.linalg.norm(field.expected_error, axis=-1), rtol=1e-6)
    assert "64x48" in repr(field) and "px" in repr(field)


def test_planes_outlive_model_and_field(tiny_checkpoint: Path, frame_pair: Pair) -> None:
    field = ajna.load(tiny_checkpoint)(*frame_pair)
    flow, copy = field.flow, field.flow.copy()
    assert not flow.flags.owndata, "the array is a view of the engine's memory, without a copy"
    del field
    gc.collect()
    np.testing.assert_array_equal(flow, copy)


@pytest.mark.parametrize("size", [(1, 1), (7, 31), (48, 64)])
def test_any_size(model: ajna.Model, size: tuple[int, int]) -> None:
    frame = np.full((*size, 3), 128, np.uint8)
    assert model(frame, frame).flow.shape == (*size, 2)


def test_layouts_of_equal_pixels_give_equal_results(model: ajna.Model, frame_pair: Pair) -> None:
    first, second = frame_pair
    expected = model(first, second).flow
    wide = np.zeros((48, 100, 3), np.uint8)
    wide[:, 10:74] = first
    layouts = {
        "padded rows": wide[:, 10:74],
        "column order": np.asfortranarray(first),
        "reversed rows": first[::-1].copy()[::-1],
        "reversed channels": first[..., ::-1].copy()[..., ::-1],
        "every second row": np.repeat(first, 2, axis=0)[::2],
    }
    for name, layout in layouts.items():
        np.testing.assert_array_equal(layout, first)
        np.testing.assert_array_equal(model(layout, second).flow, expected, err_msg=name)
    read_only = first.copy()
    read_only.flags.writeable = False
    np.testing.assert_array_equal(model(read_only, second).flow, expected)


def test_paths_and_arrays_agree(model: ajna.Model, frame_pair: Pair, tmp_path: Path) -> None:
    io = pytest.importorskip("ajna.io", reason="this build has no vision support")
    for name, frame in zip("ab", frame_pair, strict=True):
        io.write_image(tmp_path / f"{name}.png", frame)
    field = model(tmp_path / "a.png", str(tmp_path / "b.png"))
    np.testing.assert_array_equal(field.flow, model(*frame_pair).flow)
    with pytest.raises(FileNotFoundError, match="missing.png"):
        model(tmp_path / "missing.png", tmp_path / "b.png")


def test_batch_equals_one_by_one(model: ajna.Model, frame_pair: Pair) -> None:
    first, second = frame_pair
    fields = model.predict_batch([(first, second), (second, first)], timestamps_s=[1.0, 2.0])
    assert [field.timestamp_s for field in fields] == [1.0, 2.0]
    np.testing.assert_allclose(fields[0].flow, model(first, second).flow, atol=1e-4)
    np.testing.assert_allclose(fields[1].flow, model(second, first).flow, atol=1e-4)
    assert model.predict_batch([]) == []
    with pytest.raises(ValueError, match="1 time stamps"):
        model.predict_batch([(first, second)] * 2, timestamps_s=[0.0])
    with pytest.raises(ValueError, match="frame 1 of pair 1 is 32x48"):
        model.predict_batch([(first, second), (first[:, :32], second[:, :32])])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda image: image / 255.0, "float64: give uint8"),
        (lambda image: np.full(image.shape, np.nan, np.float32), "float32 and holds NaN"),
        (lambda image: image.astype(np.int32), "int32: give uint8"),
        (lambda image: image > 128, "bool: give uint8"),
        (lambda image: image[..., 0], "is grey"),
        (lambda image: image[..., :1], "is grey"),
        (lambda image: np.dstack([image, image[..., :1]]), "without alpha"),
        (lambda image: image.transpose(2, 0, 1), r"is [3, H, W]"),
        (lambda image: image[None], "give RGB [H, W, 3]"),
        (lambda image: image[..., :2], "give RGB [H, W, 3]"),
        (lambda image: image[:0], "is empty"),
        (lambda image: image[:-1], "is 64x47 but frame 1 is 64x48"),
    ],
)
def test_frames_that_are_not_rgb_bytes(model: ajna.Model, frame_pair: Pair, change: Any, message: str) -> None:
    first, second = frame_pair
    with pytest.raises(ValueError) as caught:
        model(first, change(second))
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert "frame 2" in str(caught.value)


@pytest.mark.parametrize("frame", [None, 3, [[1, 2], [3, 4]], torch.zeros(4, 4, 3, dtype=torch.uint8)])
def test_frames_that_are_no_arrays(model: ajna.Model, frame_pair: Pair, frame: Any) -> None:
    with pytest.raises(TypeError, match="numpy array"):
        model(frame_pair[0], frame)


def test_info_and_repr(model: ajna.Model, tiny_checkpoint: Path) -> None:
    info = model.info
    assert (info.name, info.path, info.format) == ("tiny", str(tiny_checkpoint), "checkpoint")
    assert (info.device, info.precision, info.flow_scale) == ("cpu", "float32", 2.0)
    assert info.network["width"] == 4 and info.stride == 16
    assert info.provenance == {"data": "none", "steps": "0"}
    assert "softplus" in info.loss
    assert model.sha256 == hashlib.sha256(tiny_checkpoint.read_bytes()).hexdigest()
    assert "tiny" in repr(model) and f"{info.parameters:,}" in repr(model)


def test_options(tiny_checkpoint: Path, frame_pair: Pair) -> None:
    before = torch.get_num_threads()
    try:
        exact = ajna.load(tiny_checkpoint, threads=1)
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
    fast = ajna.load(tiny_checkpoint, bfloat16=True)
    flow = exact(*frame_pair).flow
    np.testing.assert_allclose(fast(*frame_pair).flow, flow, atol=0.1 * float(np.abs(flow).max()))
    for options, message in (({"threads": 0}, "threads = 0"), ({"device": "gpu"}, "device 'gpu'")):
        with pytest.raises(ValueError, match=message):
            ajna.load(tiny_checkpoint, **options)
    if not torch.cuda.is_available():
        with pytest.raises(RuntimeError, match="sees 0 CUDA devices"):
            ajna.load(tiny_checkpoint, device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_equals_cpu(tiny_checkpoint: Path, model: ajna.Model, frame_pair: Pair) -> None:
    flow = model(*frame_pair).flow
    other = ajna.load(tiny_checkpoint, device="cuda")(*frame_pair).flow
    np.testing.assert_allclose(other, flow, atol=2e-2 * float(np.abs(flow).max()))  # TF32


def test_files_that_are_no_models(tmp_path: Path, tiny_checkpoint: Path) -> None:
    for name, content in {
        "text.safetensors": b"not a model",
        "empty.safetensors": b"",
        "cut.safetensors": tiny_checkpoint.read_bytes()[:-100],
        "text.pt": b"not a model",
        "model.onnx": b"onnx",
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=name) as caught:
            ajna.load(path)
        assert "\n" not in str(caught.value)
    state = tmp_path / "state.pt"
    torch.save({"a": torch.zeros(1)}, state)
    with pytest.raises(ValueError, match="TorchScript"):
        ajna.load(state)
    shutil.copy(state, tmp_path / "state.safetensors")
    with pytest.raises(ValueError, match="zip archive"):
        ajna.load(tmp_path / "state.safetensors")
    with pytest.raises(FileNotFoundError, match="none.safetensors"):
        ajna.load(tmp_path / "none.safetensors")
    with pytest.raises(ValueError):
        ajna.load(tmp_path)


def test_shipped_models_by_name(tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = tiny_checkpoint.read_bytes()
    sha = hashlib.sha256(content).hexdigest()[:8]
    path = tmp_path / f"ajna-best-{sha}.safetensors"
    path.write_bytes(content)
    (tmp_path / "README.md").write_text("not a model")
    monkeypatch.setattr(ajna.model, "_WEIGHTS", tmp_path)
    assert ajna.models() == {"best": path}
    assert ajna.load().info.path == str(path)
    assert ajna.load("best").sha256.startswith(sha)
    with pytest.raises(ValueError, match="unknown model 'bset', did you mean 'best'\\? Known: best"):
        ajna.load("bset")
    own = tmp_path / f"ajna-paper-{sha}.safetensors"
    own.write_bytes(content)
    assert ajna.models() == {"best": path, "paper": own}
    path.write_bytes(content[:-1] + b"?")
    with pytest.raises(ValueError, match="is damaged"):
        ajna.load("best")
    (tmp_path / "ajna-best-00000000.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="both model 'best'"):
        ajna.load("best")


def test_unknown_name_where_nothing_is_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ajna.model, "_WEIGHTS", tmp_path)
    with pytest.raises(ValueError, match="unknown model 'best'. Known: none"):
        ajna.load()


def test_every_shipped_model_matches_its_hash() -> None:
    for name, path in ajna.models().items():
        assert ajna.load(name).info.path == str(path)


def test_field_from_arrays() -> None:
    plane = np.zeros((2, 3, 2), np.float32)
    assert ajna.FlowField(plane, plane, plane).width == 3
    with pytest.raises(ValueError, match="one shape"):
        ajna.FlowField(plane, plane[:1], plane)


def test_other_python_threads_run_during_inference(tiny_checkpoint: Path) -> None:
    """With the GIL held a Python thread would stand still for the whole of a long call."""
    model = ajna.load(tiny_checkpoint)
    frame = np.zeros((1024, 1536, 3), np.uint8)
    steps, stop = 0, threading.Event()

    def count() -> None:
        nonlocal steps
        while not stop.is_set():
            steps += 1

    thread = threading.Thread(target=count)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # so that the counter gets next to nothing before and after the call
    thread.start()
    try:
        before = steps
        model(frame, frame)
        during = steps - before
    finally:
        stop.set()
        thread.join()
        sys.setswitchinterval(interval)
    assert during > 20_000


def test_calls_from_several_threads_agree(model: ajna.Model, frame_pair: Pair) -> None:
    expected = model(*frame_pair).flow
    with ThreadPoolExecutor(4) as pool:
        for flow in pool.map(lambda _: model(*frame_pair).flow, range(8)):
            np.testing.assert_allclose(flow, expected, atol=1e-4)


def test_import_is_light_and_names_a_torch_mismatch(tmp_path: Path) -> None:
    heavy = "{'matplotlib', 'lightning', 'torchmetrics', 'cv2', 'typer'}"
    code = f"import sys, ajna; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
    code = "import torch; torch.__version__ = '1.13.1'; import ajna"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "built against torch" in result.stderr and "torch 1.13.1 is installed" in result.stderr


def test_submodules_load_on_use() -> None:
    code = "import ajna; print(ajna.losses.UncertaintyLoss.__name__, ajna.nn.FlowNet.__name__)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "UncertaintyLoss FlowNet\n"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ajna.nothing
    assert {"load", "nn", "io"} <= set(dir(ajna))
