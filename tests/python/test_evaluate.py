# SPDX-License-Identifier: MIT
"""ajna.evaluation, the baselines and `ajna evaluate`, on a small data set written by the test."""

from __future__ import annotations

import builtins
import importlib.util
import json
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna import io
from ajna.baselines import BASELINES, BaselineField, forward_backward_difference, make_baseline
from ajna.cli.evaluate import evaluate as command
from ajna.data.pairs import PairsDataset
from ajna.evaluation import Scores, evaluate, mean_scores

HEIGHT, WIDTH = 48, 64
SHIFTS = {"slow": (2, 0), "fast": (-4, 3), "sintel_market5_final_0002": (40, 0)}
KEYS = {
    *("epe", "zero_epe", "ratio", "fl_all", "outlier_1px", "outlier_3px", "outlier_5px"),
    *("ause", "ause_fl", "rho", "pearson", "occlusion_auc", "motion_boundary_auc", "boundary_ratio"),
    *("expected_boundary_ratio", "error_boundary_ratio", "pooled_boundary_ratio", "pooled_error_boundary_ratio"),
    *("ece_px", "coverage_90", "width_90_px", "run_time_ms"),
}


def smooth_noise(random: np.random.Generator) -> np.ndarray:
    """Band-limited texture that classical flow can follow, uint8 [3 H, 3 W, 3]."""
    noise = random.normal(size=(3 * HEIGHT, 3 * WIDTH, 3))
    for axis in (0, 1):
        for _ in range(3):
            noise = (np.roll(noise, 1, axis) + noise + np.roll(noise, -1, axis)) / 3
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return (255 * noise).astype(np.uint8)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Translations of a texture: the true flow is the shift; hidden is what leaves the frame. One case has no truth."""
    folder = tmp_path_factory.mktemp("data") / "pairs"
    random = np.random.default_rng(0)
    for case, (u, v) in SHIFTS.items():
        (folder / case).mkdir(parents=True)
        texture = smooth_noise(random)
        for number, (x, y) in enumerate(((WIDTH, HEIGHT), (WIDTH - u, HEIGHT - v)), 1):
            io.write_image(folder / case / f"img{number}.png", texture[y : y + HEIGHT, x : x + WIDTH].copy())
        flow = np.broadcast_to(np.float32([u, v]), (HEIGHT, WIDTH, 2)).copy()
        valid = np.ones((HEIGHT, WIDTH), bool)
        valid[:5] = False
        (folder / case / "flow.flo").write_bytes(
            struct.pack("<fii", 202021.25, WIDTH, HEIGHT) + np.where(valid[..., None], flow, np.float32(1e10)).tobytes()
        )
        ends_x, ends_y = np.arange(WIDTH) + u, np.arange(HEIGHT)[:, None] + v
        hidden = (ends_x < 0) | (ends_x >= WIDTH) | (ends_y < 0) | (ends_y >= HEIGHT)
        mask = np.repeat(np.where(hidden, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
        io.write_image(folder / case / "occ.png", mask)
    (folder / "no_truth").mkdir()
    for number in (1, 2):
        io.write_image(folder / "no_truth" / f"img{number}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    return folder


def constant(u: float, v: float, uncertainty: float = 1.0):
    """A method that always gives one vector."""

    def method(frame1: np.ndarray, frame2: np.ndarray) -> SimpleNamespace:
        flow = np.broadcast_to(np.float32([u, v]), (*frame1.shape[:2], 2))
        return SimpleNamespace(flow=flow, uncertainty=np.full_like(flow, uncertainty))

    return method


# --- evaluation ----------------------------------------------------------------------------------------------------


def test_figures_of_a_known_answer(root: Path) -> None:
    result = evaluate(PairsDataset(root), {"two": constant(2, 0), "zero": make_baseline("zero")}, size=None, repeats=1)
    two, zero = result.methods["two"], result.methods["zero"]
    assert two.cases["slow"].epe == 0 and two.cases["slow"].ratio == 0 and two.cases["slow"].rho is None
    assert two.cases["fast"].epe == pytest.approx(np.hypot(6, 3))
    assert two.cases["fast"].zero_epe == zero.cases["fast"].epe == pytest.approx(5)
    assert two.cases["fast"].fl_all == 1.0 and two.cases["fast"].occlusion_auc == pytest.approx(0.5)
    assert two.cases["no_truth"].epe is None and two.cases["no_truth"].run_time_ms > 0
    # The extreme case counts for uncertainty only.
    assert result.uncertainty_only == ("sintel_market5_final_0002",)
    assert two.cases["sintel_market5_final_0002"].epe == pytest.approx(38)
    assert two.mean.epe == pytest.approx(np.hypot(6, 3) / 2)
    assert zero.mean.epe == zero.mean.zero_epe == pytest.approx((2 + 5) / 2) and zero.mean.ratio == 1
    assert two.mean.ratio == pytest.approx(np.hypot(6, 3) / 7)
    assert two.mean_without_excluded is None


def test_scoring_at_another_size_scales_the_truth(root: Path) -> None:
    dataset = PairsDataset(root, ["fast"])
    result = evaluate(dataset, {"zero": make_baseline("zero")}, size=(WIDTH // 2, HEIGHT // 4), repeats=1)
    assert result.methods["zero"].mean.epe == pytest.approx(np.hypot(-4 / 2, 3 / 4))


def test_excluded_cases_are_scored_but_have_a_mean_of_their_own(root: Path) -> None:
    result = evaluate(PairsDataset(root), {"zero": make_baseline("zero")}, size=None, exclude=["fast"], repeats=1)
    report = result.methods["zero"]
    assert report.cases["fast"].epe == pytest.approx(5) and report.mean.epe == pytest.approx(3.5)
    assert report.mean_without_excluded is not None and report.mean_without_excluded.epe == pytest.approx(2)
    with pytest.raises(ValueError, match="'fats' is not a case of .*did you mean 'fast'"):
        evaluate(PairsDataset(root), {"zero": make_baseline("zero")}, exclude=["fats"])


def test_mean_scores_skip_what_is_undefined() -> None:
    cases = {
        "a": Scores(epe=1.0, zero_epe=4.0, ause=0.2, run_time_ms=1.0),
        "b": Scores(epe=3.0, zero_epe=4.0, ause=0.4, rho=0.5, run_time_ms=9.0),
        "c": Scores(run_time_ms=2.0),
        "d": Scores(epe=100.0, zero_epe=100.0, ause=0.9),
    }
    mean = mean_scores(cases, without_errors=["d"])
    assert (mean.epe, mean.zero_epe, mean.ratio) == (2.0, 4.0, 0.5)
    assert mean.ause == pytest.approx(0.5) and mean.rho == 0.5 and mean.run_time_ms == 2.0
    assert mean.fl_all is None and mean_scores({}).epe is None


def test_methods_that_answer_nonsense_are_named(root: Path) -> None:
    dataset = PairsDataset(root, ["slow"])
    with pytest.raises(RuntimeError, match=r"method 'bad' gave \d+ values of flow that are not finite for 'slow'"):
        evaluate(dataset, {"bad": constant(np.nan, 0)}, size=None)
    with pytest.raises(RuntimeError, match=r"method 'bad' gave \d+ values of uncertainty"):
        evaluate(dataset, {"bad": constant(0, 0, np.inf)}, size=None)
    with pytest.raises(RuntimeError, match=r"method 'bad' gave flow of shape \(1, 1, 2\)"):
        evaluate(dataset, {"bad": lambda a, b: BaselineField(np.zeros((1, 1, 2)), np.zeros((1, 1, 2)))}, size=None)
    with pytest.raises(ValueError, match="repeats=0"):
        evaluate(dataset, {"zero": make_baseline("zero")}, repeats=0)


# --- baselines -----------------------------------------------------------------------------------------------------


def test_forward_backward_difference_of_known_flows() -> None:
    x, y = np.meshgrid(np.arange(20, dtype=np.float32), np.arange(10, dtype=np.float32))
    forward = np.stack([np.full_like(x, 1.5), np.full_like(x, -0.5)], axis=-1)
    # A backward flow that is linear in x and y is interpolated exactly: its value at the end of the forward vector.
    backward = np.stack([0.1 * x, 0.2 * y], axis=-1)
    expected = forward + np.stack([0.1 * np.clip(x + 1.5, 0, 19), 0.2 * np.clip(y - 0.5, 0, 9)], axis=-1)
    assert np.allclose(forward_backward_difference(forward, backward), expected, atol=1e-5)
    assert np.abs(forward_backward_difference(forward, -forward)).max() == 0


@pytest.mark.parametrize("name", ["dis", "farneback"])
def test_classical_flow_follows_a_translation(root: Path, name: str) -> None:
    pytest.importorskip("cv2", reason="needs opencv-python-headless")
    report = evaluate(PairsDataset(root, ["slow"]), {name: make_baseline(name)}, size=None, repeats=1).methods[name]
    scores = report.cases["slow"]
    assert scores.ratio is not None and scores.ratio < 0.3
    assert scores.occlusion_auc is not None and scores.occlusion_auc > 0.6
    assert report.curves is not None and report.curves.ause.item() == pytest.approx(scores.ause)


def test_baselines_say_what_they_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="unknown baseline method 'diss'; did you mean 'dis'"):
        make_baseline("diss")
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("dis", "farneback"):
        with pytest.raises(RuntimeError, match="needs OpenCV's Python package.*pip install opencv-python-headless"):
            make_baseline(name)
    assert make_baseline("zero")


def test_importing_the_package_does_not_need_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__
    monkeypatch.setattr(
        builtins, "__import__", lambda name, *rest: real(name, *rest) if name != "cv2" else pytest.fail("imported cv2")
    )
    for module in [name for name in sys.modules if name.startswith("ajna.baselines")]:
        monkeypatch.delitem(sys.modules, module)
    importlib.import_module("ajna.baselines")


# --- command -------------------------------------------------------------------------------------------------------


def run(*arguments: str):
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_prints_a_table_with_means_and_notes(root: Path) -> None:
    result = run("--root", root, "--method", "zero", "--size", "full", "--exclude", "fast", "--repeats", 1)
    assert result.exit_code == 0, result.output
    for text in (*SHIFTS, "no_truth", "mean without excluded", "excluded: fast", "3.50", "100.0%", "AUSE"):
        assert text in result.output
    assert "sintel_market5_final_0002: extreme motion, for judging uncertainty only" in result.output


def test_the_command_writes_json_and_pictures(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    result = run("--root", root, "--method", "zero", "--size", "64x48", "--out", out, "--json", "--repeats", 1)
    assert result.exit_code == 0, result.output
    written = json.loads((out / "evaluation.json").read_text())
    assert written == json.loads(result.stdout)
    assert written["dataset"] == "pairs" and written["size"] == [64, 48]
    assert written["uncertainty_only_cases"] == ["sintel_market5_final_0002"]
    zero = written["methods"]["zero"]
    assert set(zero["mean"]) == set(zero["cases"]["slow"]) == KEYS and zero["mean_without_excluded"] is None
    assert zero["mean"]["epe"] == pytest.approx(3.5) and zero["cases"]["no_truth"]["epe"] is None
    pictures = [f"zero_{case}.png" for case in (*SHIFTS, "no_truth")]
    assert sorted(path.name for path in out.iterdir()) == sorted(["evaluation.json", "sparsification.png", *pictures])
    assert io.read_image(out / "zero_slow.png").shape[2] == 3


def test_all_runs_every_baseline_side_by_side(root: Path) -> None:
    pytest.importorskip("cv2", reason="needs opencv-python-headless")
    result = run("--root", root, "--method", "all", "--cases", "slow,fast", "--size", "full", "--repeats", 1)
    assert result.exit_code == 0, result.output
    assert "means side by side" in result.output and all(name in result.output for name in BASELINES)
    assert "no_truth" not in result.output


def test_models_are_loaded_by_name_and_default_to_best(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ajna

    loaded = []

    def load(name: str, device: str, threads: int | None):
        loaded.append((name, device, threads))
        field = constant(2, 0)
        return lambda a, b: SimpleNamespace(**vars(field(a, b)), expected_error=np.ones((*a.shape[:2], 2), np.float32))

    monkeypatch.setattr(ajna, "load", load, raising=False)
    result = run("--root", root, "--cases", "slow", "--size", "full", "--json", "--repeats", 1)
    assert result.exit_code == 0, result.output
    assert loaded == [("best", "cpu", None)] and json.loads(result.stdout)["methods"]["best"]["mean"]["fl_all"] == 0
    two = ["--model", "best", "--model", "some/dir/other.safetensors", "--method", "zero"]
    result = run(
        "--root", root, "--cases", "slow", "--json", "--repeats", 1, "--device", "cuda:0", "--threads", 2, *two
    )
    assert list(json.loads(result.stdout)["methods"]) == ["best", "other.safetensors", "zero"]
    assert loaded[1:] == [("best", "cuda:0", 2), ("some/dir/other.safetensors", "cuda:0", 2)]


def test_aligned_models_stand_beside_the_models_and_see_what_else_moves(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture moves as one plane: a model that sees no motion is right once that is out. Baselines stay."""
    import ajna

    def load(name: str, device: str, threads: int | None):
        field = constant(0, 0)
        return lambda a, b: SimpleNamespace(**vars(field(a, b)), expected_error=np.ones((*a.shape[:2], 2), np.float32))

    monkeypatch.setattr(ajna, "load", load, raising=False)
    result = run(
        *("--root", root, "--cases", "slow", "--size", "320x240", "--json", "--repeats", 1),
        *("--model", "best", "--method", "zero", "--align"),
    )
    assert result.exit_code == 0, result.output
    epe = {name: method["mean"]["epe"] for name, method in json.loads(result.stdout)["methods"].items()}
    assert list(epe) == ["best", "best-aligned", "zero"]
    assert epe["best"] == epe["zero"] == pytest.approx(10.0)
    assert epe["best-aligned"] < 0.5


def test_bad_arguments_are_errors_with_a_reason(root: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for arguments, error, reason in (
        (["--root", tmp_path / "nowhere", "--method", "zero"], FileNotFoundError, "does not exist; expected ROOT/CASE"),
        (["--root", root, "--method", "raft"], ValueError, "unknown baseline method 'raft'"),
        (["--root", root, "--method", "zero", "--size", "320"], ValueError, "size '320' is not WIDTHxHEIGHT"),
        (["--root", root, "--method", "zero", "--cases", "slwo"], ValueError, "did you mean 'slow'"),
        (["--root", root, "--method", "zero", "--out", tmp_path / "file"], ValueError, "file' is a file"),
    ):
        before = sorted(tmp_path.rglob("*"))
        result = run(*arguments)
        assert sorted(tmp_path.rglob("*")) == before
        assert isinstance(result.exception, error) and reason in str(result.exception), result.output


def test_the_script_of_the_source_tree_is_the_same_command(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = Path(__file__).parents[2] / "train" / "evaluate.py"
    if not script.exists():
        pytest.skip("the source tree's train/ is not here")
    spec = importlib.util.spec_from_file_location("train_evaluate", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    arguments = ["--root", str(root), "--method", "zero", "--json", "--repeats", "1", "--cases", "slow"]
    assert module.main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["methods"]["zero"]["mean"]["epe"] > 0
    assert module.main(["--root", str(root / "nowhere")]) == 2
    assert "does not exist" in capsys.readouterr().err
