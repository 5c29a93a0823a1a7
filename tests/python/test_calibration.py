# SPDX-License-Identifier: MIT
"""ajna.calibration, `ajna calibrate`, and intervals in engine, TorchScript and evaluation, on small networks."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

import ajna
from ajna import _core, calibration, nn
from ajna.calibration.fitting import split
from ajna.cli import main
from ajna.data.frame_pair import FramePair

SIZE = (48, 32)
SCENE = {"bank_size": 8, "texture_size": 64}  # textures are what takes time to make
SET = ["--set", "bank_size=8", "--set", "texture_size=64"]


@pytest.fixture(scope="module")
def scenes() -> calibration.SyntheticScenes:
    return calibration.SyntheticScenes(60, *SIZE, seed=3, scene=SCENE)


@pytest.fixture(scope="module")
def anxious(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that expects ten times the errors of its loss."""
    net, metadata = _core.load_checkpoint(tiny_checkpoint)
    table = metadata.table
    metadata.table = _core.UncertaintyTable(table.raw_min, table.raw_step, table.uncertainty, 10 * table.expected_error)
    path = tmp_path_factory.mktemp("anxious") / "anxious.safetensors"
    _core.save_checkpoint(path, net, metadata)
    return path


@pytest.fixture(scope="module")
def result(anxious: Path, scenes: calibration.SyntheticScenes) -> calibration.CalibrationResult:
    return calibration.fit(anxious, scenes)


@pytest.fixture(scope="module")
def calibrated(result: calibration.CalibrationResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibrated") / "tiny.safetensors"
    result.save(path)
    return path


# --- fitting -------------------------------------------------------------------------------------------------------


def test_a_model_learns_what_its_errors_are(result: calibration.CalibrationResult) -> None:
    assert result.images == {"expected_error": 24, "intervals": 24, "held_out": 12}
    assert result.after.reliability.ece < 0.5 * result.before.reliability.ece
    assert result.before.intervals_from == "Laplace distribution" and result.after.intervals_from == "conformal"
    assert result.after.coverage.error < result.before.coverage.error
    levels = [0.5, 0.68, 0.8, 0.9, 0.95]
    assert result.metadata.calibration is not None and result.metadata.calibration.factors.levels == levels
    assert result.skipped_levels == (0.99,)  # 24 images reach 24 / 25
    provenance = result.metadata.calibration.provenance
    assert provenance["images"] == "48" and provenance["pixels"] == str(48 * 48 * 32) and provenance["date"]
    assert provenance["data"] == "synthetic scenes without photographs, seed 3, bank_size=8, texture_size=64"


def test_the_curve_rises_and_the_uncertainty_stays(result: calibration.CalibrationResult, anxious: Path) -> None:
    _, old = nn.load_checkpoint(anxious)
    table = result.metadata.table
    assert torch.equal(table.uncertainty, old["table"].uncertainty)
    assert table.expected_error.diff().min() >= 0 and table.expected_error[0] > 0
    assert not torch.equal(table.expected_error, old["table"].expected_error)


def test_equal_input_gives_equal_output(anxious: Path, scenes, result: calibration.CalibrationResult) -> None:
    again = calibration.fit(anxious, scenes)
    assert torch.equal(again.metadata.table.expected_error, result.metadata.table.expected_error)
    assert again.metadata.calibration.factors == result.metadata.calibration.factors
    other = calibration.fit(anxious, scenes, weighting="pixel", seed=1)
    assert other.metadata.calibration.factors.levels[-1] == 0.99  # pixels are many
    assert not torch.equal(other.metadata.table.expected_error, result.metadata.table.expected_error)


def test_split_is_disjoint_and_keeps_groups() -> None:
    names = [f"video{k // 7}/frame{k}" for k in range(70)]
    plain = split(names)
    assert sorted(i for part in plain for i in part) == list(range(70)) and [len(part) for part in plain] == [
        28,
        28,
        14,
    ]
    assert split(names) == plain and split(names, seed=1) != plain
    grouped = split(names, group=lambda name: name.split("/")[0])
    videos = [{names[i].split("/")[0] for i in part} for part in grouped]
    assert sum(map(len, videos)) == 10 and all(videos)
    # With as few groups as parts each gets one.
    assert all(split(names[:21], group=lambda name: name.split("/")[0]))
    assert all(split(list("abcd"), (0.9, 0.05, 0.05)))
    with pytest.raises(ValueError, match="at least 3 groups of images, there are 2"):
        split(names[:14], group=lambda name: name.split("/")[0])
    with pytest.raises(ValueError, match="three numbers above 0"):
        split(names, (1.0, 0.0, 1.0))


class Pairs:
    """A source with pairs that have no ground truth, some that cannot be read, and sparse ground truth."""

    def __init__(self, skip_bad: bool) -> None:
        self.names, self.skip_bad = tuple(f"p{k}" for k in range(12)), skip_bad
        self._scenes = calibration.SyntheticScenes(12, *SIZE, scene=SCENE)

    def read(self, index: int) -> FramePair:
        pair = self._scenes.read(index)
        if index == 4:
            raise ValueError("file 'p4.flo' is damaged")
        if index == 5:
            return FramePair("p5", pair.frame1, pair.frame2)
        assert pair.flow is not None and pair.valid is not None
        valid = pair.valid.copy()
        valid[:, : index * 3] = False
        flow = np.where(valid[..., None], pair.flow, np.float32(np.nan))
        return FramePair(pair.name, pair.frame1, pair.frame2, flow=flow, valid=valid)


def test_sources_with_gaps(tiny_checkpoint: Path) -> None:
    result = calibration.fit(tiny_checkpoint, Pairs(skip_bad=True), levels=[0.5], data="pairs")
    assert sum(result.images.values()) == 10 and result.bad == {"p4": "file 'p4.flo' is damaged"}
    assert result.metadata.calibration.provenance["data"] == "pairs"
    with pytest.raises(ValueError, match=r"p4.flo' is damaged"):
        calibration.fit(tiny_checkpoint, Pairs(skip_bad=False))
    with pytest.raises(ValueError, match="0.95 needs at least 19 images"):
        calibration.fit(tiny_checkpoint, Pairs(skip_bad=True), levels=[0.5, 0.95])
    with pytest.raises(ValueError, match="strictly rising"):
        calibration.fit(tiny_checkpoint, Pairs(skip_bad=True), levels=[0.9, 0.5])
    with pytest.raises(ValueError, match="unknown pixel weighting 'imge', did you mean 'image'"):
        calibration.fit(tiny_checkpoint, Pairs(skip_bad=True), weighting="imge")


# --- application ---------------------------------------------------------------------------------------------------


def test_engine_and_script_apply_it(calibrated: Path, tmp_path: Path, frame_pair) -> None:
    net, metadata = nn.load_checkpoint(calibrated)
    nn.export_torchscript(tmp_path / "tiny.pt", net, metadata)
    field = ajna.load(calibrated)(*frame_pair)
    low, high = field.interval(0.9)
    factors = metadata["calibration"].factors
    reach = np.array(factors.at(0.9), dtype=np.float32) * field.expected_error
    assert low.shape == field.flow.shape and low.dtype == np.float32
    assert np.allclose(field.flow - low, reach, atol=1e-4) and np.allclose(high - field.flow, reach, atol=1e-4)
    narrow = field.interval(0.5)
    assert (low <= narrow[0]).all() and (narrow[1] <= high).all()
    between = [np.mean(np.subtract(*field.interval(p)[::-1])) for p in (0.8, 0.85, 0.9)]
    assert between[1] == pytest.approx((between[0] + between[2]) / 2, rel=1e-4)
    for path in (calibrated, tmp_path / "tiny.pt"):
        model = ajna.load(path)
        assert model.info.calibrated and model.info.interval_levels == factors.levels
        assert model.info.calibration["images"] == "48"
        assert np.allclose(model(*frame_pair).interval(0.9)[0], low, atol=1e-3)
        assert model.predict_batch([frame_pair])[0].conformal == factors
    copy = pickle.loads(pickle.dumps(field))
    assert np.array_equal(copy.interval(0.9)[0], low)
    with pytest.raises(ValueError, match=r"0.99 lies outside the calibrated levels .*ajna calibrate MODEL --levels"):
        field.interval(0.99)


def test_without_calibration_an_interval_says_what_to_do(tiny_checkpoint: Path, frame_pair) -> None:
    model = ajna.load(tiny_checkpoint)
    assert not model.info.calibrated and model.info.calibration == {} and model.info.interval_levels == []
    with pytest.raises(ValueError, match="ajna calibrate MODEL --dataset NAME --root DIR --out NEW.safetensors"):
        model(*frame_pair).interval(0.9)


def test_a_calibrated_model_is_calibrated_anew(calibrated: Path, scenes) -> None:
    again = calibration.fit(calibrated, scenes, levels=[0.5, 0.9])
    assert again.before.intervals_from == "conformal"
    # Same split, same data: there is nothing left to correct.
    assert abs(again.after.reliability.ece - again.before.reliability.ece) < 0.05
    assert calibration.fit(calibrated, scenes, levels=[0.3]).before.intervals_from == "Laplace distribution"


def test_a_script_cannot_be_calibrated(calibrated: Path, tmp_path: Path, scenes) -> None:
    with pytest.raises(ValueError, match="is not a checkpoint"):
        calibration.fit(tmp_path / "tiny.pt", scenes)
    with pytest.raises(ValueError, match="unknown model 'bset'"):
        calibration.fit("bset", scenes)


def test_evaluation_scores_calibrated_models_only(calibrated: Path, tiny_checkpoint: Path, scenes) -> None:
    pytest.importorskip("ajna.io", reason="needs the build with vision", exc_type=ImportError)
    from ajna.data.dataset import FlowDataset
    from ajna.evaluation import evaluate

    class Scenes(FlowDataset):
        def read(self, index: int) -> FramePair:
            return scenes.read(index)

        def files(self, index: int) -> list[Path]:
            return []

        def parts(self, index: int) -> frozenset[str]:
            return frozenset({"flow"})

    dataset = Scenes("scenes", scenes.names[:6])
    models = {"yes": ajna.load(calibrated), "no": ajna.load(tiny_checkpoint)}
    record = evaluate(dataset, models, size=None, repeats=1).to_json()["methods"]
    yes, no = record["yes"], record["no"]
    assert no["calibration"] is None and no["mean"]["coverage_90"] is None and no["mean"]["ece_px"] is None
    assert yes["calibration"]["levels"] == [0.5, 0.68, 0.8, 0.9, 0.95]
    per_case = [scores["coverage_90"] for scores in yes["cases"].values()]
    assert yes["mean"]["coverage_90"] == pytest.approx(np.mean(per_case))
    assert yes["calibration"]["coverage"][3] == pytest.approx(np.mean(per_case))
    for name in ("outlier_1px", "ause_fl", "pearson", "motion_boundary_auc"):
        assert no["mean"][name] is not None, name
    # The uncertainty is the same, only the expected error differs.
    assert yes["mean"]["ause"] == pytest.approx(no["mean"]["ause"])


# --- the command ---------------------------------------------------------------------------------------------------


def test_the_command(anxious: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    io = pytest.importorskip("ajna.io", reason="needs the build with vision", exc_type=ImportError)
    out, plot = tmp_path / "new" / "a.safetensors", tmp_path / "new" / "a.png"
    command = ["calibrate", str(anxious), "--dataset", "synthetic", *SET, "--size", "48x32", "--scenes", "30"]
    assert main([*command, "--out", str(out), "--plot", str(plot), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["images"] == {"expected_error": 12, "intervals": 12, "held_out": 6}
    assert record["levels"] == [0.5, 0.68, 0.8, 0.9] and record["skipped_levels"] == [0.95, 0.99]
    assert record["held_out"]["after"]["ece_px"] < record["held_out"]["before"]["ece_px"]
    assert ajna.load(out).info.calibration["size"] == "48x32"
    assert io.read_image(plot).shape[2] == 3
    assert main([*command, "--out", str(out), "--levels", "0.5,0.9", "--seed", "1"]) == 0
    text = capsys.readouterr().out
    assert "coverage of the 90% interval" in text and "6 held-out images" in text and str(out) in text
    assert sorted(path.name for path in out.parent.iterdir()) == ["a.png", "a.safetensors"]


def test_the_command_reads_data_sets(tiny_checkpoint: Path, tmp_path: Path, capsys, scenes) -> None:
    io = pytest.importorskip("ajna.io", reason="needs the build with vision", exc_type=ImportError)
    for index in range(9):
        pair, folder = scenes.read(index), tmp_path / "pairs" / f"v{index // 3}_{index}"
        folder.mkdir(parents=True)
        io.write_image(folder / "img1.png", pair.frame1)
        io.write_image(folder / "img2.png", pair.frame2)
        io.write_flo(folder / "flow.flo", pair.flow)
    arguments = ["--dataset", "pairs", "--root", str(tmp_path / "pairs"), "--out", str(tmp_path / "b.safetensors")]
    command = ["calibrate", str(tiny_checkpoint), *arguments, "--size", "full", "--levels", "0.5"]
    assert main([*command, "--group", r"^(v\d)_", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["images"] == {"expected_error": 3, "intervals": 3, "held_out": 3}
    assert record["provenance"]["data"] == "pairs in pairs" and record["provenance"]["size"] == "each pair's own"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--dataset", "pairs"], "needs its folder: give --root"),
        (["--dataset", "sintle", "--root", "."], "data set 'sintle' is unknown; did you mean 'sintel'"),
        (["--root", "."], "leave out --root"),
        (["--set", "bank_sice=8"], "unknown scene option 'bank_sice', did you mean 'bank_size'"),
        (["--set", "layers=many"], "scene option 'layers' = 'many': give a value of type int"),
        (["--set", "mix=gap"], "scene option 'mix' = 'gap': give presets with weights"),
        (["--set", "mix=gap:1,pyle:1"], "unknown scene preset 'pyle'"),
        (["--size", "full"], "no size of their own"),
        (["--size", "48"], "is not WIDTHxHEIGHT"),
        (["--levels", "0.5,x"], "not numbers"),
        (["--levels", "0.9,0.5"], "strictly rising"),
        (["--levels", "0.5,0.95"], "needs at least 19 images, there are 2"),
        (["--weighting", "pixle"], "did you mean 'pixel'"),
        (["--group", "("], "not a regular expression"),
        (["--group", "a"], "has no group"),
        (["--group", "(a)"], "does not match image 'scene_00000'"),
        (["--plot", "a.jpg"], "ends in .png"),
        (["--out", "a.pt"], "ends in .safetensors"),
        (["--photos", "nowhere"], "photograph folder 'nowhere' does not exist"),
    ],
)
def test_bad_arguments_are_one_sentence(
    arguments: list[str], reason: str, tiny_checkpoint: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["calibrate", str(tiny_checkpoint), "--out", "sub/a.safetensors", "--scenes", "5", "--size", "32x16"]
    if "--set" not in arguments and "pairs" not in arguments and "sintle" not in arguments:
        command += SET
    assert main([*command, *arguments]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_the_core_refuses_what_it_would_not_read() -> None:
    with pytest.raises(ValueError, match="'data'"):
        _core.Calibration(_core.ConformalFactors([0.5], [(1.0, 1.0)]), {})
    with pytest.raises(ValueError, match="at least one level"):
        _core.ConformalFactors([], [])
    fitted = _core.isotonic_regression(torch.tensor([3.0, 1.0, 2.0, 5.0]), torch.tensor([1.0, 1.0, 2.0, 1.0]))
    assert fitted.tolist() == [2.0, 2.0, 2.0, 5.0]
