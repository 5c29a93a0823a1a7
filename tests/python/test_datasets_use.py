# SPDX-License-Identifier: MIT
"""Bad samples, scoring and names: what all data sets have in common."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import data_trees as trees

from ajna.cli import main
from ajna.data.chairs import FlyingChairs2
from ajna.data.dataset import FlowDataset
from ajna.data.pack import pack
from ajna.data.registry import DATASETS, open_dataset, options_of, parse_options
from ajna.data.things import FlyingThings3D
from ajna.evaluation import evaluate

make, TREES, HEIGHT, WIDTH = trees.make, trees.TREES, trees.HEIGHT, trees.WIDTH


# --- bad data ------------------------------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def other_size(path: Path) -> None:
    trees.write_flo(path, np.zeros((HEIGHT, WIDTH - 1, 2), np.float32), np.ones((HEIGHT, WIDTH - 1), bool))


def not_a_number(path: Path) -> None:
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[3, 5, 1] = np.nan
    trees.write_flo(path, flow, np.ones((HEIGHT, WIDTH), bool))


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        ("0000000-img_0.png", cut, "img_0.png' is "),
        ("0000000-img_1.png", Path.unlink, "case '0000000' lacks '.*0000000-img_1.png'"),
        ("0000000-flow_01.flo", cut, "flow_01.flo' is truncated"),
        ("0000000-flow_01.flo", other_size, "0000000-flow_01.flo is 19x12, but 0000000-img_0.png is 20x12.*/train/"),
        ("0000000-flow_01.flo", not_a_number, "flow_01.flo' is not finite at 1 pixels .*first at x 5, y 3"),
        ("0000000-occ_01.png", cut, "occ_01.png' is "),
    ],
)
def test_bad_samples_are_named_or_listed(
    tmp_path: Path, file: str, damage: Callable[[Path], None], message: str
) -> None:
    t = make("chairs2", tmp_path)
    damage(tmp_path / "train" / file)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        FlyingChairs2(tmp_path)[0]
    assert str(tmp_path / "train" / file) in str(error.value)
    data = FlyingChairs2(tmp_path, skip_bad=True)
    assert len(data) == 2 and data[0].name == "0000003" and list(data.bad) == ["0000000"]
    assert str(tmp_path / "train" / file) in data.bad["0000000"]
    assert [pair.name for pair in data.pairs()] == ["0000003"]
    assert np.array_equal(data[-1].frame1, t.images["train/0000003-img_0.png"])
    with pytest.raises(IndexError):
        data[2]


def test_only_bad_samples(tmp_path: Path) -> None:
    make("chairs2", tmp_path)
    for path in (tmp_path / "train").glob("*-flow_01.flo"):
        not_a_number(path)
    data = FlyingChairs2(tmp_path, skip_bad=True)
    with pytest.raises(ValueError, match="none of the 2 samples of .* can be used; the first: .*not finite"):
        data[0]
    with pytest.raises(ValueError, match="none of the 2 samples"):
        evaluate(data, {"one": constant})


def test_a_grey_pfm_is_no_flow(tmp_path: Path) -> None:
    make("things3d", tmp_path)
    path = tmp_path / "optical_flow/TRAIN/A/0000/into_future/left/OpticalFlowIntoFuture_0006_L.pfm"
    path.write_bytes(b"Pf\n20 12\n-1.0\n" + np.zeros((12, 20), "<f4").tobytes())
    with pytest.raises(ValueError, match="OpticalFlowIntoFuture_0006_L.pfm' has one channel"):
        FlyingThings3D(tmp_path)[0]


# --- evaluation ----------------------------------------------------------------------------------------------------


def constant(frame1: np.ndarray, frame2: np.ndarray) -> SimpleNamespace:
    """The same flow everywhere; an uncertainty that differs everywhere."""
    shape = (*frame1.shape[:2], 2)
    uncertainty = 0.1 + np.random.default_rng(5).random(shape).astype(np.float32)
    return SimpleNamespace(flow=np.broadcast_to(np.float32([1.5, -0.5]), shape).copy(), uncertainty=uncertainty)


@pytest.mark.parametrize("name", sorted(TREES))
def test_evaluation_equals_brute_force(tmp_path: Path, name: str) -> None:
    make(name, tmp_path)
    data = open_dataset(name, tmp_path, scoring=True)
    report = evaluate(data, {"one": constant}, size=None, repeats=1).methods["one"]
    assert tuple(report.cases) == data.names
    for pair in (data[index] for index in range(len(data))):
        scores, result = report.cases[pair.name], constant(pair.frame1, pair.frame2)
        errors, lengths, bad = [], [], 0
        hidden, shown = [], []
        for y, x in np.argwhere(pair.valid):
            (u, v), (true_u, true_v) = result.flow[y, x], pair.flow[y, x]
            error, length = np.hypot(u - true_u, v - true_v), np.hypot(true_u, true_v)
            errors.append(error)
            lengths.append(length)
            bad += error > 3 and error > 0.05 * length
            if pair.occlusion is not None:
                (hidden if pair.occlusion[y, x] else shown).append(np.hypot(*result.uncertainty[y, x]))
        assert scores.epe == pytest.approx(np.mean(errors), rel=1e-5)
        assert scores.zero_epe == pytest.approx(np.mean(lengths), rel=1e-5)
        assert scores.fl_all == pytest.approx(bad / len(errors))
        if pair.occlusion is None:
            assert scores.occlusion_auc is None
        else:
            wins = np.mean([(h > s) + 0.5 * (h == s) for h in hidden for s in shown])
            assert scores.occlusion_auc == pytest.approx(wins, abs=1e-5)


def test_the_command_takes_names_options_and_skips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t = make("sintel", tmp_path)
    base = ["evaluate", "--root", str(tmp_path), "--method", "zero", "--size", "full", "--repeats", "1"]
    assert main([*base, "--dataset", "sintel", "--set", "pass_name=final", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["dataset"] == "sintel" and record["bad_cases"] == {}
    flow, invalid = (
        t.flows["training/flow/alley_1/frame_0002.flo"][0],
        t.masks["training/invalid/alley_1/frame_0002.png"],
    )
    epe = np.hypot(flow[..., 0], flow[..., 1])[~invalid].mean()
    assert record["methods"]["zero"]["cases"]["final/alley_1/frame_0002"]["epe"] == pytest.approx(epe, rel=1e-5)
    cut(tmp_path / "training/flow/market_5/frame_0001.flo")
    assert main([*base, "--dataset", "sintel"]) == 2
    assert "market_5/frame_0001.flo' is truncated" in capsys.readouterr().err
    assert main([*base, "--dataset", "sintel", "--skip-bad"]) == 0
    shown = capsys.readouterr().out
    assert "cannot be read: 1" in shown and "market_5/frame_0001.flo' is truncated" in shown
    for wrong, message in (
        (["--dataset", "sintl"], "data set 'sintl' is unknown; did you mean 'sintel'?"),
        (
            ["--dataset", "sintel", "--set", "pas=final"],
            "data set 'sintel' has no option 'pas'; it has split, pass_name",
        ),
        (["--dataset", "sintel", "--set", "final"], "option 'final' is not KEY=VALUE"),
        (["--dataset", "kitti2015"], "KITTI 2015: folder"),
    ):
        assert main([*base, *wrong]) == 2
        assert message in capsys.readouterr().err


# --- registry ------------------------------------------------------------------------------------------------------


def test_every_registered_set_is_a_flow_dataset_with_common_options() -> None:
    for name, entry in DATASETS.items():
        kind = entry.load()
        assert issubclass(kind, FlowDataset) and kind.title != FlowDataset.title and kind.__doc__, name
        assert set(entry.scored) <= set(options_of(name)) and "max_flow" in options_of(name), name


def test_options_come_as_text(tmp_path: Path) -> None:
    make("chairs2", tmp_path)
    options = parse_options(["direction=both", "backward=true", "max_flow=400"])
    data = open_dataset("chairs2", tmp_path, options=options)
    assert len(data) == 4 and data.max_flow == 400 and data[0].backward is not None
    with pytest.raises(ValueError, match="option max_flow=far is not a number"):
        open_dataset("chairs2", tmp_path, options={"max_flow": "far"})
    with pytest.raises(ValueError, match="option backward=1 is not a yes or no"):
        open_dataset("chairs2", tmp_path, options={"backward": "1"})
    with pytest.raises(ValueError, match="option 'split' is given twice"):
        parse_options(["split=val", "split=train"])
    with pytest.raises(ValueError, match="'0000009' is not a case of .*did you mean"):
        FlyingChairs2(tmp_path, cases=["0000009"])


def test_packs_are_read_without_vision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a training server whose build has no OpenCV."""
    t = make("chairs2", tmp_path / "source")
    pack(FlyingChairs2(tmp_path / "source"), tmp_path / "pack")
    monkeypatch.setitem(sys.modules, "ajna.io", None)
    monkeypatch.delattr("ajna.io")
    for name in ("packed", "pack_format", "dataset", "frame_pair"):
        monkeypatch.delitem(sys.modules, f"ajna.data.{name}")
    fresh = importlib.import_module("ajna.data.packed")
    assert fresh.FlowDataset is not FlowDataset
    data = fresh.PackedDataset(tmp_path / "pack")
    assert len(data) == 2 and np.array_equal(data[1].frame2, t.images["train/0000003-img_1.png"])
