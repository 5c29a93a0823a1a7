# SPDX-License-Identifier: MIT
"""The command line: what it writes, and that bad input gives one sentence, exit code 2 and nothing half-written."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import ajna

io = pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna.cli import main  # noqa: E402

Pair = tuple[np.ndarray, np.ndarray]
RESULTS = {"flow.flo", "uncertainty.pfm", "flow.png", "uncertainty.png", "overview.png"}
COMMANDS = (
    "predict",
    "video",
    "task",
    "sim",
    "replay",
    "evaluate",
    "calibrate",
    "export",
    "info",
    "losses",
    "bench",
    "study",
    "synth",
)


@pytest.fixture
def frames(tmp_path: Path, frame_pair: Pair) -> list[str]:
    """Paths of the pair as PNG files."""
    paths = [tmp_path / "in" / f"frame{number}.png" for number in (1, 2)]
    paths[0].parent.mkdir()
    for path, frame in zip(paths, frame_pair, strict=True):
        io.write_image(path, frame)
    return [str(path) for path in paths]


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs the command line, expects exit code 2 with one sentence on stderr and nothing on stdout; the sentence."""

    def run(*arguments: object) -> str:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        # File descriptors, not sys.stderr: C++ libraries, too, must be silent.
        output, error = capfd.readouterr()
        assert code == 2, error
        assert output == ""
        assert error.startswith("ajna: ")
        assert error.endswith("\n")
        assert error.count("\n") == 1, error
        assert "Traceback" not in error
        return error

    return run


# --- predict -------------------------------------------------------------------------------------------------------


def test_predict_writes_what_the_model_says(
    tmp_path: Path,
    frames: list[str],
    frame_pair: Pair,
    tiny_checkpoint: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "deep" / "out"
    assert main(["predict", *frames, "--out", str(out), "--model", str(tiny_checkpoint)]) == 0
    output = capsys.readouterr().out
    assert output.count("\n") == 1
    assert output.startswith("64x48: ")
    assert all(name in output for name in RESULTS)
    assert {file.name for file in out.iterdir()} == RESULTS

    field = ajna.load(str(tiny_checkpoint))(*frame_pair)
    np.testing.assert_array_equal(io.read_flo(out / "flow.flo"), field.flow)
    np.testing.assert_array_equal(io.read_pfm(out / "uncertainty.pfm")[..., :2], field.uncertainty)
    assert io.read_image(out / "flow.png").shape == (48, 64, 3)
    assert io.read_image(out / "uncertainty.png").shape == (48, 64, 3)
    assert io.read_image(out / "overview.png").std() > 10


def test_predict_json_and_size(
    tmp_path: Path, frames: list[str], tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--out", str(tmp_path / "out"), "--model", str(tiny_checkpoint), "--size", "32x24", "--threads", "1"]
    assert main(["predict", *frames, *arguments, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["width"], summary["height"]) == (32, 24)
    assert {Path(name).name for name in summary["files"]} == RESULTS
    flow = io.read_flo(tmp_path / "out" / "flow.flo")
    assert flow.shape == (24, 32, 2)
    assert summary["mean_flow_px"] == pytest.approx(np.linalg.norm(flow, axis=2).mean(), rel=1e-5)


def test_predict_replaces_old_results_and_keeps_other_files(
    tmp_path: Path, frames: list[str], tiny_checkpoint: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "flow.flo").write_text("old")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert main(["predict", *frames, "--out", str(tmp_path / "out"), "--model", str(tiny_checkpoint)]) == 0
    assert {file.name for file in (tmp_path / "out").iterdir()} == {*RESULTS, "notes.txt"}
    assert io.read_flo(tmp_path / "out" / "flow.flo").shape == (48, 64, 2)


@pytest.mark.parametrize(
    ("bad", "expected"),
    [
        ("missing", "does not exist"),
        ("text", "is not an image but text"),
        ("truncated", "is truncated"),
        ("empty", "is empty"),
        ("folder", "is a folder"),
        ("unequal", "64x48 but"),
    ],
)
def test_predict_refuses_bad_images(
    tmp_path: Path, frames: list[str], tiny_checkpoint: Path, refused: Callable[..., str], bad: str, expected: str
) -> None:
    path = tmp_path / "in" / "bad.png"
    if bad == "text":
        path.write_text("these are words, not pixels\n")
    elif bad == "truncated":
        path.write_bytes(Path(frames[1]).read_bytes()[:-20])
    elif bad == "empty":
        path.touch()
    elif bad == "folder":
        path.mkdir()
    elif bad == "unequal":
        io.write_image(path, np.zeros((50, 64, 3), np.uint8))
    for pair in ((frames[0], path), (path, frames[0])):
        if bad == "unequal" and pair[0] is path:
            continue
        error = refused("predict", *pair, "--out", tmp_path / "out", "--model", tiny_checkpoint)
        assert expected in error
        assert "bad.png" in error
        assert not (tmp_path / "out").exists()


def test_predict_refuses_bad_places(
    tmp_path: Path, frames: list[str], tiny_checkpoint: Path, refused: Callable[..., str]
) -> None:
    model = ("--model", tiny_checkpoint)
    file = tmp_path / "file"
    file.write_text("x")
    assert "is a file" in refused("predict", *frames, "--out", file, *model)
    assert "is a file" in refused("predict", *frames, "--out", file / "below", *model)
    assert "not writable" in refused("predict", *frames, "--out", "/proc/ajna", *model)
    assert file.read_text() == "x"
    (tmp_path / "out" / "flow.png").mkdir(parents=True)
    assert "flow.png' is a folder" in refused("predict", *frames, "--out", tmp_path / "out", *model)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["flow.png"]


def test_predict_refuses_bad_models(tmp_path: Path, frames: list[str], refused: Callable[..., str]) -> None:
    out = tmp_path / "out"
    known = next(iter(ajna.models()), None)
    error = refused("predict", *frames, "--out", out, "--model", "bset" if known is None else known[:-1] + "_")
    assert "unknown model" in error
    assert known is None or f"did you mean '{known}'" in error
    assert "does not exist" in refused("predict", *frames, "--out", out, "--model", tmp_path / "no.safetensors")
    (tmp_path / "text.safetensors").write_text("not a model")
    assert "text.safetensors" in refused("predict", *frames, "--out", out, "--model", tmp_path / "text.safetensors")
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--size", "0x0"], "0x0"),
        (["--size", "32"], "WIDTHxHEIGHT"),
        (["--size", "-3x5"], "-3x5"),
        (["--size", "100000x2"], "100000x2"),
        (["--threads", "0"], "--threads"),
        (["--threads", "many"], "--threads"),
        (["--device", "abacus"], "abacus"),
        (["--device", "cuda:99"], "cuda:99"),
        (["--sise", "3x3"], "--sise"),
        (["extra.png"], "extra.png"),
    ],
)
def test_predict_refuses_impossible_options(
    tmp_path: Path,
    frames: list[str],
    tiny_checkpoint: Path,
    refused: Callable[..., str],
    arguments: list[str],
    expected: str,
) -> None:
    error = refused("predict", *frames, "--out", tmp_path / "out", "--model", tiny_checkpoint, *arguments)
    assert expected in error
    assert not (tmp_path / "out").exists()


# --- video ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, frame_pair: Pair) -> Path:
    """Four frames: the texture moves to and fro."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number, frame in enumerate(frame_pair * 2):
        io.write_image(folder / f"{number}.png", frame)
    return folder


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_video_of_a_folder(
    tmp_path: Path, folder: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    out = tmp_path / "out" / name
    arguments = ["--model", str(tiny_checkpoint), "--fps", "5", "--json"]
    assert main(["video", str(folder), "--out", str(out), *arguments]) == 0
    output, error = capsys.readouterr()
    summary = json.loads(output)
    assert summary["frames"] == 4
    assert summary["max_flow_px"] > 0
    assert error == ""
    source = io.VideoSource(out)
    assert (source.width, source.height, source.fps) == (3 * 64, 48, 5.0)
    pictures = [frame.image for frame in source]
    assert len(pictures) == 3
    # Pairs 1 and 3 are the same frames, and the colour scale is one over the video.
    assert np.abs(pictures[0].astype(int) - pictures[2]).mean() < 6
    first = io.read_image(folder / "0.png")
    assert np.abs(pictures[0][:, :64].astype(int) - first).mean() < 12
    assert [file.name for file in out.parent.iterdir()] == [name]


def test_video_of_a_video_file(
    tmp_path: Path, folder: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with io.VideoWriter(tmp_path / "in.mp4", 64, 48, 12.0) as writer:
        for frame in io.VideoSource(folder):
            writer.write(frame.image)
    out = tmp_path / "out.mp4"
    arguments = ["--model", str(tiny_checkpoint), "--max-frames", "3", "--size", "32x24"]
    arguments += ["--max-flow", "5", "--max-uncertainty", "2"]
    assert main(["video", str(tmp_path / "in.mp4"), "--out", str(out), *arguments]) == 0
    assert "3 frames at 12 per second; colour scale: flow to 5 px, uncertainty to 2; wrote" in capsys.readouterr().out
    source = io.VideoSource(out)
    assert (source.width, source.height, len(list(source))) == (96, 24, 2)


def test_video_refuses_bad_sources(
    tmp_path: Path, folder: Path, tiny_checkpoint: Path, refused: Callable[..., str]
) -> None:
    out = tmp_path / "out" / "a.mp4"
    options = ("--out", out, "--model", tiny_checkpoint)
    (tmp_path / "empty").mkdir()
    assert "holds no images" in refused("video", tmp_path / "empty", *options)
    assert "does not exist" in refused("video", tmp_path / "missing.mp4", *options)
    (tmp_path / "text.mp4").write_text("words")
    assert "not a readable video" in refused("video", tmp_path / "text.mp4", *options)
    assert "camera 987" in refused("video", "987", *options)
    (folder / "2.png").write_text("words")
    assert "2.png" in refused("video", folder, *options)  # in the middle of the work
    for number in (1, 2, 3):
        (folder / f"{number}.png").unlink()
    assert "single frame" in refused("video", folder, *options)
    assert not out.parent.exists()


def test_video_refuses_bad_options(
    tmp_path: Path, folder: Path, tiny_checkpoint: Path, refused: Callable[..., str]
) -> None:
    model = ("--model", tiny_checkpoint)
    before = set(tmp_path.rglob("*"))
    assert "'.gif'" in refused("video", folder, "--out", tmp_path / "a.gif", *model)
    assert "is a file" in refused("video", folder, "--out", folder / "0.png" / "a.mp4", *model)
    assert "not writable" in refused("video", folder, "--out", "/proc/a.mp4", *model)
    for option in (["--fps", "0"], ["--max-frames", "1"], ["--max-flow", "0"], ["--size", "0x9"], ["--threads", "0"]):
        refused("video", folder, "--out", tmp_path / "a.mp4", *model, *option)
    assert set(tmp_path.rglob("*")) == before


# --- export, info, evaluate ----------------------------------------------------------------------------------------


def test_export_is_verified_and_runs_without_ajna(
    tmp_path: Path, frame_pair: Pair, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "tiny.pt"
    assert (
        main(["export", "--model", str(tiny_checkpoint), "--format", "torchscript", "--out", str(out), "--json"]) == 0
    )
    summary = json.loads(capsys.readouterr().out)
    assert summary["max_abs_difference"] < 1e-4
    assert [file.name for file in out.parent.iterdir()] == ["tiny.pt"]

    code = (
        "import sys, torch\n"
        "flow, uncertainty, error = torch.jit.load(sys.argv[1]).predict(*torch.load(sys.argv[2]))\n"
        "assert 'ajna' not in sys.modules\n"
        "torch.save(flow, sys.argv[3])\n"
    )
    tensors = [torch.from_numpy(frame).permute(2, 0, 1)[None].contiguous() for frame in frame_pair]
    torch.save(tensors, tmp_path / "frames.pt")
    command = [sys.executable, "-c", code, str(out), str(tmp_path / "frames.pt"), str(tmp_path / "flow.pt")]
    subprocess.run(command, check=True, cwd=tmp_path)
    expected = ajna.load(str(tiny_checkpoint))(*frame_pair).flow
    flow = torch.load(tmp_path / "flow.pt")[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(flow, expected, atol=1e-3, rtol=1e-3)


def test_export_refuses(tmp_path: Path, tiny_checkpoint: Path, refused: Callable[..., str]) -> None:
    assert "is a folder" in refused("export", "--out", tmp_path, "--model", tiny_checkpoint)
    assert "not writable" in refused("export", "--out", "/proc/a.pt", "--model", tiny_checkpoint)
    assert "--format" in refused("export", "--out", tmp_path / "a.pt", "--format", "punch-cards")
    assert "unknown model" in refused("export", "--out", tmp_path / "a.pt", "--model", "nobody")
    assert not list(tmp_path.iterdir())


def test_info(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["versions"]["ajna"] == ajna.__version__
    assert record["build"]["vision"] is True
    assert record["devices"]["cpu"]["threads"] >= 1
    assert {model["name"] for model in record["models"]} == set(ajna.models())
    assert main(["info"]) == 0
    assert f"ajna {ajna.__version__}" in capsys.readouterr().out


def test_evaluate_is_registered(tmp_path: Path, refused: Callable[..., str]) -> None:
    assert "missing" in refused("evaluate", "--root", tmp_path / "missing", "--model", "best")


# --- the program itself --------------------------------------------------------------------------------------------


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"ajna {ajna.__version__} (torch {torch.__version__})\n"
    for arguments in ([], ["--help"]):
        assert main(arguments) == 0
        output = capsys.readouterr().out
        assert all(command in output for command in COMMANDS)
    for command in COMMANDS:
        assert main([command, "--help"]) == 0
        output = capsys.readouterr().out
        assert f"Example: ajna {command}" in " ".join(output.split())


def test_usage_errors(refused: Callable[..., str]) -> None:
    assert "predict" in refused("pridict")
    assert "ajna predict --help" in refused("predict")
    assert "--out" in refused("predict", "a.png", "b.png")


def test_help_needs_no_heavy_import() -> None:
    code = (
        "import sys\n"
        "from ajna.cli import main\n"
        "main(['predict', '--help'])\n"
        "heavy = {'cv2', 'lightning', 'matplotlib', 'torchmetrics'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_the_process_speaks_once_and_returns_the_code(tmp_path: Path, tiny_checkpoint: Path) -> None:
    """In a process of its own, as OpenCV and FFmpeg take their log level when they are first used."""
    (tmp_path / "text.mp4").write_text("words")
    for arguments in (
        ["predict", "no.png", "no.png", "--out", "out"],
        ["video", "text.mp4", "--out", "a.mp4", "--model", str(tiny_checkpoint)],
        ["video", "987", "--out", "a.mp4", "--model", str(tiny_checkpoint)],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "ajna.cli", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 2, done.stderr
        assert done.stdout == ""
        assert done.stderr.count("\n") == 1, done.stderr
        assert done.stderr.startswith("ajna: ")
    assert [file.name for file in tmp_path.iterdir()] == ["text.mp4"]
