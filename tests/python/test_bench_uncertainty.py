# SPDX-License-Identifier: MIT
"""`ajna bench uncertainty`: one table of time and quality, scored like `ajna evaluate`; and the generated data set."""

from __future__ import annotations

import json
import re
import statistics
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import ajna
from ajna import io
from ajna.baselines import DeepEnsemble, SamplingOptions
from ajna.benchmarks.machine import cpu_model
from ajna.benchmarks.uncertainty import LABELS, NO_WEIGHTS, compare, percentile
from ajna.cli import main
from ajna.data.pairs import PairsDataset
from ajna.data.synthetic import SyntheticScenes
from ajna.evaluation import evaluate

SIZE = (64, 48)
NO_OPENCV = "one_pass,mc_dropout,mc_dropout_mixture,ensemble,ensemble_mixture,forward_backward"
TIMES = ("run_time_ms", "run_time_p90_ms", "run_time_ratio")
FIGURES = ("epe", "ause", "rho", "occlusion_auc")

Pair = tuple[np.ndarray, np.ndarray]
Bench = Callable[..., str]


@pytest.fixture(scope="module")
def root(frame_pair: Pair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pairs with ground truth and an occlusion mask."""
    folder = tmp_path_factory.mktemp("bench") / "pairs"
    flow = np.broadcast_to(np.float32([3, -2]), (SIZE[1], SIZE[0], 2))
    hidden = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    hidden[:, -6:] = 255
    for case, turn in (("one", 0), ("two", 5)):
        (folder / case).mkdir(parents=True)
        for number, frame in enumerate(frame_pair, 1):
            io.write_image(folder / case / f"img{number}.png", np.roll(frame, turn, axis=0))
        (folder / case / "flow.flo").write_bytes(struct.pack("<fii", 202021.25, *SIZE) + flow.tobytes())
        io.write_image(folder / case / "occ.png", hidden)
    return folder


@pytest.fixture
def bench(root: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> Bench:
    """Runs the command on the pairs with the tiny network; what it prints."""

    def run(*arguments: object) -> str:
        options = ["--dataset", "pairs", "--root", root, "--model", tiny_checkpoint, "--size", "64x48"]
        assert main(["bench", "uncertainty", *map(str, [*options, *arguments])]) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return run


def rows_of(record: dict) -> dict[str, dict]:
    return {row["name"]: row for row in record["rows"]}


# --- the table -----------------------------------------------------------------------------------------------------


def test_figures_are_those_of_evaluate_and_times_are_there(
    bench: Bench, root: Path, tiny_checkpoint: Path, member_runs: Path
) -> None:
    record = json.loads(
        bench("--members-from", member_runs, "--method", NO_OPENCV, "--passes", 3, "--repeats", 2, "--json")
    )
    rows = rows_of(record)
    assert list(rows) == NO_OPENCV.split(",")
    one_pass = rows["one_pass"]
    for row in rows.values():
        assert row["missing"] is None and all(row[key] > 0 for key in TIMES) and None not in map(row.get, FIGURES)
        assert row["run_time_p90_ms"] >= row["run_time_ms"]
        assert row["run_time_ratio"] == pytest.approx(row["run_time_ms"] / one_pass["run_time_ms"])
    assert one_pass["run_time_ratio"] == 1 and one_pass["passes"] == 1
    assert [rows[name]["passes"] for name in ("mc_dropout", "ensemble", "forward_backward")] == [3, 3, 2]
    assert rows["ensemble"]["parameters"] == 3 * one_pass["parameters"]
    assert rows["mc_dropout"]["flops"] == rows["ensemble"]["flops"] == 3 * one_pass["flops"]
    members = [ajna.load(path) for path in sorted(member_runs.glob("*/model.safetensors"))]
    methods = {"one_pass": ajna.load(tiny_checkpoint), "ensemble_mixture": DeepEnsemble(members, "laplace")}
    for name, report in evaluate(PairsDataset(root), methods, size=SIZE, repeats=1).methods.items():
        for figure in FIGURES:
            assert rows[name][figure] == getattr(report.mean, figure), (name, figure)


def test_rows_without_weights_hold_no_numbers(bench: Bench) -> None:
    arguments = ("--method", "ensemble,ensemble_mixture,forward_backward", "--repeats", 1)
    rows = rows_of(json.loads(bench(*arguments, "--json")))
    for name in ("ensemble", "ensemble_mixture"):
        assert rows[name]["missing"] == NO_WEIGHTS
        assert all(rows[name][key] is None for key in rows[name] if key not in ("name", "label", "missing"))
    lines = [line for line in bench(*arguments).splitlines() if line.startswith("| deep ensemble")]
    assert len(lines) == 2
    for line in lines:
        assert NO_WEIGHTS in line and not re.search(r"\d", line)


def test_markdown_names_model_machine_versions_and_what_dropout_means(
    bench: Bench, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "out"
    text = bench("--method", "mc_dropout", "--passes", 2, "--layer", "encoder.3", "--repeats", 1, "--out", out)
    assert (out / "uncertainty.md").read_text() == text
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 4 and len({line.count("|") for line in table}) == 1
    for expected in (
        ajna.load(tiny_checkpoint).sha256[:16],
        cpu_model(),
        f"ajna {ajna.__version__}",
        "2 pairs, run and scored at 64x48; 1 timed calls a pair",
        "channels of encoder.3 dropped at rate 0.1 in a network trained without dropout",
    ):
        assert expected in text
    record = json.loads((out / "uncertainty.json").read_text())
    assert record["machine"]["threads"] >= 1 and record["machine"]["cores"] >= 1 and record["cases"] == 2
    assert record["model"]["file"] == tiny_checkpoint.name and record["options"]["layers"] == ["encoder.3"]
    assert sorted(path.name for path in out.iterdir()) == ["uncertainty.json", "uncertainty.md"]


def test_all_methods_run_by_default(bench: Bench) -> None:
    pytest.importorskip("cv2", reason="needs opencv-python-headless")
    rows = rows_of(json.loads(bench("--passes", 2, "--repeats", 1, "--threads", 1, "--json")))
    assert list(rows) == list(LABELS)
    assert rows["dis"]["passes"] == 2 and rows["dis"]["parameters"] == 0 and rows["dis"]["flops"] is None


def test_without_opencv_its_rows_say_so(root: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "cv2", None)
    arguments = {"dataset_name": "pairs", "size": SIZE, "repeats": 1, "options": SamplingOptions(passes=2)}
    model = ajna.load(tiny_checkpoint)
    table = compare(PairsDataset(root), model, **arguments)
    missing = {row.name: row.missing for row in table.rows}
    assert missing["dis"] == missing["farneback"] == "needs OpenCV's Python package"
    assert missing["mc_dropout"] is None and missing["ensemble"] == NO_WEIGHTS
    with pytest.raises(RuntimeError, match="pip install opencv-python-headless"):
        compare(PairsDataset(root), model, methods=["dis"], **arguments)


def test_excluded_cases_stay_out_of_the_means(root: Path, tiny_checkpoint: Path) -> None:
    arguments = {"dataset_name": "pairs", "size": SIZE, "repeats": 1, "methods": ["one_pass"]}
    model = ajna.load(tiny_checkpoint)
    table = compare(PairsDataset(root), model, exclude=["two"], **arguments)
    alone = compare(PairsDataset(root, ["one"]), model, **arguments)
    assert table.rows[0].epe == alone.rows[0].epe and table.cases == alone.cases == 1


def test_percentile_is_numpys() -> None:
    values = list(np.random.default_rng(0).normal(size=37))
    assert percentile(values, 90) == pytest.approx(np.percentile(values, 90))
    assert percentile(values, 50) == pytest.approx(statistics.median(values)) and percentile([3.0], 90) == 3


# --- what it refuses -----------------------------------------------------------------------------------------------


def test_bad_arguments_give_one_sentence(
    root: Path, member_runs: Path, tiny_checkpoint: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    pairs = ("--dataset", "pairs", "--root", root, "--model", tiny_checkpoint)
    one_run = member_runs / "member0"
    for arguments, reason in (
        (("--dataset", "pairs"), "data set 'pairs' lies in a folder: give --root DIR"),
        (("--dataset", "synthetic", "--root", root), "it takes no --root"),
        (("--dataset", "piars", "--root", root), "did you mean 'pairs'"),
        ((*pairs, "--member", tiny_checkpoint), "alone is no ensemble; give two members"),
        ((*pairs, "--member", tiny_checkpoint, "--member", tiny_checkpoint), "are the same network"),
        ((*pairs, "--members-from", tmp_path / "nowhere"), "nowhere' does not exist"),
        ((*pairs, "--members-from", tmp_path / "empty"), "holds no runs: expected"),
        ((*pairs, "--members-from", one_run), "is one run, hence one member"),
        ((*pairs, "--rate", "1.5"), "dropout rate 1.5 is not in [0, 1)"),
        ((*pairs, "--passes", "1"), "passes = 1: a variance needs at least 2"),
        ((*pairs, "--layer", "encoder.55"), "did you mean 'encoder.5'"),
        ((*pairs, "--mixture", "gausian"), "did you mean 'gaussian'"),
        ((*pairs, "--method", "mc-dropout"), "unknown method 'mc-dropout' to compare; did you mean 'mc_dropout'"),
        ((*pairs, "--size", "full"), "size 'full' is not WIDTHxHEIGHT"),
        ((*pairs, "--exclude", "tow"), "did you mean 'two'"),
    ):
        out = tmp_path / "out"
        capfd.readouterr()
        code = main(["bench", "uncertainty", *map(str, arguments), "--out", str(out)])
        output, error = capfd.readouterr()
        assert code == 2 and output == "" and reason in error, error
        assert error.startswith("ajna: ") and error.count("\n") == 1 and not out.exists()


# --- the same methods in `ajna evaluate` ---------------------------------------------------------------------------


def test_evaluate_takes_them_by_name(
    root: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    arguments = ["evaluate", "--root", str(root), "--model", str(tiny_checkpoint), "--size", "64x48", "--repeats", "1"]
    arguments += ["--cases", "one"]
    assert main([*arguments, "--method", "forward_backward,mc_dropout", "--json", "--out", str(tmp_path / "out")]) == 0
    methods = json.loads(capsys.readouterr().out)["methods"]
    assert list(methods) == [tiny_checkpoint.name, "forward_backward", "mc_dropout"]
    assert methods["forward_backward"]["mean"]["epe"] == methods[tiny_checkpoint.name]["mean"]["epe"]
    assert (tmp_path / "out" / "mc_dropout_one.png").is_file()
    assert main([*arguments, "--method", "ensemble"]) == 2
    assert "an ensemble of 1 has no spread" in capsys.readouterr().err
    assert main([*arguments, "--method", "forward_bakward"]) == 2
    assert "did you mean 'forward_backward'" in capsys.readouterr().err


# --- generated scenes ----------------------------------------------------------------------------------------------


def test_scenes_are_the_same_every_time_and_held_out() -> None:
    small = {"bank_size": 8, "texture_size": 64}
    first, again = (SyntheticScenes(3, *SIZE, seed=4, scene=small) for _ in range(2))
    pair, same = first[1], again[1]
    assert first.names == ("scene_00000", "scene_00001", "scene_00002") and pair.size == SIZE
    assert np.array_equal(pair.frame1, same.frame1) and np.array_equal(pair.flow, same.flow)
    assert not np.array_equal(pair.frame1, first[2].frame1)
    assert not np.array_equal(pair.frame1, SyntheticScenes(3, *SIZE, seed=5, scene=small)[1].frame1)
    assert pair.valid.all() and pair.occlusion.dtype == pair.motion_boundary.dtype == bool
    assert pair.flow.shape == (SIZE[1], SIZE[0], 2) and pair.flow.dtype == np.float32
    for options, message in (
        ({"count": 0}, "0 scenes of 320x240 with seed 0: give at least 1"),
        ({"seed": -1}, "with seed -1: give at least"),
        ({"width": 0}, "scenes of 0x240"),
        ({"scene": {"bank_sise": 3}}, "unknown scene option 'bank_sise', did you mean 'bank_size'"),
    ):
        with pytest.raises(ValueError, match=message):
            SyntheticScenes(**options)


def test_scenes_of_a_mix_are_those_of_its_presets() -> None:
    small = {"bank_size": 8, "texture_size": 64}
    count = 12
    mixed = SyntheticScenes(count, *SIZE, seed=4, scene={**small, "mix": {"gap": 1, "pile": 1}})
    alone = {name: SyntheticScenes(count, *SIZE, seed=4, scene={**small, "preset": name}) for name in ("gap", "pile")}
    found = []
    for index in range(count):
        frame = mixed[index].frame1
        (name,) = [name for name, scenes in alone.items() if np.array_equal(scenes[index].frame1, frame)]
        found.append(name)
    assert set(found) == {"gap", "pile"}
    assert "mix={'gap': 1, 'pile': 1}" in mixed.describe()
    with pytest.raises(ValueError, match="'preset' and 'mix' were both given"):
        SyntheticScenes(2, scene={"preset": "gap", "mix": {"gap": 1}})
