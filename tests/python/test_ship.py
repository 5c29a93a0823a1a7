# SPDX-License-Identifier: MIT
"""train/ship.py: a trained model becomes a shipped one, with its hash and its card."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

from ajna import losses, nn

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "ship.py"


@pytest.fixture
def ship() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ship", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    provenance = {
        "steps": 12,
        "samples": 96,
        "training_seconds": 90,
        "skipped_steps": 0,
        "torch": "2",
        "data": "scenes",
    }
    nn.save_checkpoint(
        folder / "model.safetensors",
        nn.FlowNet(width=4),
        name="tiny",
        loss=losses.UncertaintyLoss(),
        flow_scale=8.0,
        provenance=provenance,
    )
    (folder / "config.yaml").write_text("name: tiny\nruns: /somewhere/private\nseed: 1\n")
    mean = {"epe": 1.234, "ratio": 0.5, "ause": 0.25, "rho": 0.5, "occlusion_auc": None}
    (folder / "scores.json").write_text(json.dumps({"methods": {"tiny": {"mean": mean}}}))
    return folder


def arguments(run: Path, into: Path) -> list[str]:
    return [
        *("--run", str(run), "--name", "tiny", "--scores", str(run / "scores.json"), "--into", str(into)),
        *("--hardware", "a test", "--note", "It knows nothing."),
    ]


def test_ships_weights_and_card(ship: ModuleType, run: Path, tmp_path: Path) -> None:
    into = tmp_path / "weights"
    into.mkdir()
    (into / "ajna-tiny-00000000.safetensors").write_bytes(b"an older one")
    (into / "ajna-other-00000000.safetensors").write_bytes(b"another model")
    assert ship.main(arguments(run, into)) == 0
    digest = hashlib.sha256((run / "model.safetensors").read_bytes()).hexdigest()[:8]
    names = sorted(path.name for path in into.iterdir())
    assert names == ["ajna-other-00000000.safetensors", f"ajna-tiny-{digest}.safetensors", "ajna-tiny.md"]
    text = (into / "ajna-tiny.md").read_text()
    assert "12 steps, 96 samples" in text
    assert "| tiny | 1.23 | 50.0% | 0.250 | 0.50 | – |" in text
    assert "It knows nothing." in text
    assert "private" not in text


def test_bad_input_is_one_sentence(
    ship: ModuleType, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "model.safetensors").unlink()
    assert ship.main(arguments(run, tmp_path)) == 2
    assert "model.safetensors" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.md"))


def test_card_adds_the_run_that_it_began_with(ship: ModuleType, run: Path, tmp_path: Path) -> None:
    earlier = tmp_path / "earlier.safetensors"
    provenance = {"steps": "1000", "samples": "8000", "training_seconds": "3510"}
    nn.save_checkpoint(earlier, nn.FlowNet(width=4), "first", losses.UncertaintyLoss(), 8.0, provenance)
    into = tmp_path / "weights"
    into.mkdir()
    assert ship.main([*arguments(run, into), "--earlier", str(earlier)]) == 0
    text = (into / "ajna-tiny.md").read_text()
    assert "12 steps, 96 samples, 2 minutes on a test, after 1,000 steps, 8,000 samples, 58 minutes" in text
    assert "1,012 steps, 8,096 samples, 60 minutes in all" in text
    assert "**Calibration**: none" in text
