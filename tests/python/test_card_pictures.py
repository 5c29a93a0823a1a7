# SPDX-License-Identifier: MIT
"""train/card_pictures.py: curves of a run, and the scenes on which a model errs most without knowing it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("lightning")
pytest.importorskip("matplotlib")

import ajna
from ajna.io import read_image

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "card_pictures.py"


@pytest.fixture
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("card_pictures", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_worst_scenes_come_first(script: ModuleType) -> None:
    """A model that says zero flow and expects no error is most wrong where most moves."""

    def still(frame1: np.ndarray, frame2: np.ndarray) -> ajna.FlowField:
        plane = np.zeros((*frame1.shape[:2], 2), np.float32)
        return ajna.FlowField(plane, plane + np.float32(1e-3), plane + np.float32(1e-3))

    titles = []
    monkey = pytest.MonkeyPatch()
    from ajna import plots

    def panel(pair, field, title, width):
        titles.append((title, float(np.linalg.norm(pair.flow, axis=2)[pair.valid].mean())))
        return np.zeros((10, width, 3), np.uint8)

    monkey.setattr(plots, "uncertainty_panel", panel)
    try:
        picture = script.failures(still, scenes=2, count=3, width=40)
    finally:
        monkey.undo()
    assert picture.shape == (30, 40, 3)
    motions = [motion for _, motion in titles]
    assert motions == sorted(motions, reverse=True) and motions[0] > motions[2]


def test_files_and_errors(
    script: ModuleType, tiny_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "run" / "csv" / "version_0" / "metrics.csv"
    log.parent.mkdir(parents=True)
    log.write_text("epoch,step,train/loss,val/ause,val/epe\n0,10,1.0,,\n0,20,0.8,,\n0,20,,0.3,2.0\n")
    common = ["--model", str(tiny_checkpoint), "--scenes", "1", "--count", "1", "--name", "tiny"]
    assert script.main([*common, "--run", str(tmp_path / "run"), "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"curves_tiny.png", "failures_tiny.png"}
    assert read_image(tmp_path / "failures_tiny.png").std() > 5
    assert not list(tmp_path.glob(".*"))
    capsys.readouterr()
    assert script.main([*common, "--out", str(tmp_path / "none")]) == 2
    assert "make it first" in capsys.readouterr().err
    assert script.main([*common, "--run", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "metrics.csv" in capsys.readouterr().err
