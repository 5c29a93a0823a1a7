# SPDX-License-Identifier: MIT
"""train/scaling.py: runs of several lengths, and the power law through them."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")

TRAIN = Path(__file__).resolve().parents[2] / "train"

if not (TRAIN / "scaling.py").is_file():
    pytest.skip("the script is not part of the wheel and the source tree is absent", allow_module_level=True)

CONFIG = """
save_every: 1
threads: 1
trainer: {max_steps: 4, precision: 32-true, enable_progress_bar: false, val_check_interval: 4}
model:
  net: {width: 4}
  flow_scale: 4.0
  guidance: {heads_weight: 0.0}
  loss: {l1_steps: 2, blend_steps: 2}
data:
  scene: {bank_size: 4, texture_size: 32, layers: 1}
  stages: [{from_step: 0, height: 32, width: 48, batch: 2}, {from_step: 2, height: 48, width: 48, batch: 2}]
  validation: {batches: 1, batch: 2, height: 48, width: 64}
"""


@pytest.fixture
def scaling(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TRAIN)  # as Python does for a script
    for name in ("comparison", "scaling"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    module = importlib.import_module("scaling")
    for part in (module, sys.modules["comparison"]):
        monkeypatch.setattr(part, "SCORED_AT", (64, 48))
    return module


def test_the_fit_finds_the_law_that_the_errors_follow(scaling: ModuleType) -> None:
    samples = np.array([1e3, 2e3, 4e3, 8e3])
    scenes = np.random.default_rng(0).uniform(0.5, 2.0, 40)
    law = scaling.fit(samples, 30.0 * samples[:, None] ** -0.4 * scenes / scenes.mean())
    assert law.exponent == pytest.approx(0.4) and law.factor == pytest.approx(30.0)
    assert law.exponent_interval == pytest.approx((0.4, 0.4))
    assert law.at(1e5) == pytest.approx(30.0 * 1e5**-0.4)


def test_the_interval_holds_the_law_under_noise(scaling: ModuleType) -> None:
    random = np.random.default_rng(1)
    samples = np.array([1e3, 2e3, 4e3, 8e3])
    held = 0
    for _ in range(20):
        noisy = 30.0 * samples[:, None] ** -0.4 * random.lognormal(0.0, 0.4, (4, 64))
        low, high = scaling.fit(samples, noisy).exponent_interval
        held += low <= 0.4 <= high
    assert held >= 16  # of 20 at 95 %


def test_an_error_that_is_no_number_is_refused(scaling: ModuleType) -> None:
    with pytest.raises(ValueError, match="no positive number"):
        scaling.fit([1, 2, 4], np.array([[1.0], [np.nan], [0.5]]))


def test_the_whole_schedule_is_stretched(scaling: ModuleType) -> None:
    config = yaml.safe_load((TRAIN / "configs" / "synthetic.yaml").read_text())
    steps = config["trainer"]["max_steps"]
    half = scaling.stretched(config, steps // 2)
    assert half["trainer"]["max_steps"] == steps // 2
    assert half["model"]["loss"]["l1_steps"] == config["model"]["loss"]["l1_steps"] // 2
    assert half["data"]["stages"][1]["from_step"] == config["data"]["stages"][1]["from_step"] // 2
    assert half["model"]["optim"]["lr"] == config["model"]["optim"]["lr"]
    assert scaling.stretched(half, steps) == config
    with pytest.raises(ValueError, match=r"trainer\.max_steps"):
        scaling.stretched({"model": {}}, 10)


@pytest.mark.usefixtures("one_thread")
def test_trains_fits_and_writes_the_table(
    scaling: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, page, runs = tmp_path / "tiny.yaml", tmp_path / "page.md", tmp_path / "runs"
    config.write_text(CONFIG)
    marks = sys.modules["comparison"].MarkedPage(page, "scaling.py")
    page.write_text(f"before\n{marks.begin}\nold\n{marks.end}\nafter\n")
    options = ["--config", config, "--runs", runs, "--scenes", "2", "--steps", "4,2,8", "--markdown", page]
    assert scaling.main(list(map(str, options))) == 0, capsys.readouterr().err
    record = json.loads((runs / "scaling.json").read_text())
    assert [run["samples"] for run in record["runs"]] == [4, 8, 16]
    assert np.isfinite(record["fit"]["exponent"])
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text and "at 160" in text

    model = runs / "steps2" / "model.safetensors"
    before = model.stat().st_mtime_ns
    assert scaling.main([*map(str, options), "--only-score", "--also", str(model)]) == 0
    assert model.stat().st_mtime_ns == before and "(steps2, not fitted)" in page.read_text()

    given = [*(f"{model}:{samples}" for samples in (100, 30)), str(model), str(model)]
    assert scaling.main([*map(str, options), "--models", *given]) == 0, capsys.readouterr().err
    record = json.loads((runs / "scaling.json").read_text())
    assert [run["samples"] for run in record["runs"]] == [4, 30, 100]
    assert "finished models" in page.read_text()
    assert scaling.main([*map(str, options), "--models", str(model), str(model)]) == 2
    assert "1 models of different samples" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--steps", "100,200"], "--steps 100,200"),
        (["--steps", "100,100,200"], "three or more different"),
        (["--steps", "a,b,c"], "--steps a,b,c"),
        (["--scenes", "1"], "--scenes 1"),
        (["--only-score"], "0 complete runs"),
        (["--only-score", "--trainer.precision=32-true"], "--trainer.precision=32-true"),
        (["--models", "a", "--trainer.precision=32-true"], "--models trains nothing"),
        (["--models", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--markdown", "nowhere.md"], "nowhere.md"),
    ],
)
def test_refusals_are_one_sentence(
    scaling: ModuleType, options: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scaling.main(["--runs", str(tmp_path / "runs"), *options]) == 2
    said = capsys.readouterr().err.strip()
    assert named in said and len(said.splitlines()) == 1
