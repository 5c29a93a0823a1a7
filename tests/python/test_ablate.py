# SPDX-License-Identifier: MIT
"""train/ablate.py: variants at equal samples, one table."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "ablate.py"

if not SCRIPT.is_file():
    pytest.skip("the script is not part of the wheel and the source tree is absent", allow_module_level=True)

CONFIG = """
save_every: 1
threads: 1
trainer: {max_steps: 2, precision: 32-true, enable_progress_bar: false, val_check_interval: 2}
model:
  net: {width: 4}
  flow_scale: 4.0
  guidance: {heads_weight: 0.0}
  loss: {l1_steps: 1, blend_steps: 1}
data:
  scene: {bank_size: 4, texture_size: 32, layers: 1}
  stages: [{from_step: 0, height: 32, width: 48, batch: 2}]
  validation: {batches: 1, batch: 2, height: 48, width: 64}
"""


@pytest.fixture
def ablate(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(SCRIPT.parent)  # as Python does for a script
    for name in ("comparison", "ablate"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    module = importlib.import_module("ablate")
    for part in (module, sys.modules["comparison"]):
        monkeypatch.setattr(part, "SCORED_AT", (64, 48))
    return module


@pytest.mark.usefixtures("one_thread")
def test_trains_scores_and_writes_the_table(
    ablate: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, page, runs = tmp_path / "tiny.yaml", tmp_path / "page.md", tmp_path / "runs"
    marks = sys.modules["comparison"].MarkedPage(page, "ablate.py")
    config.write_text(CONFIG)
    page.write_text(f"before\n{marks.begin}\nold\n{marks.end}\nafter\n")
    options = ["--config", config, "--runs", runs, "--scenes", "2", "--variants", "paper,heads", "--markdown", page]
    options += ["--jobs", "2"]
    assert ablate.main(list(map(str, options))) == 0, capsys.readouterr().err
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    rows = {row["variant"]: row for row in json.loads((runs / "ablation.json").read_text())}
    assert list(rows) == ["paper", "heads"]
    assert all(row["samples"] == 4 and row["scores"][0]["epe"] > 0 for row in rows.values())
    assert rows["heads"]["parameters"] > rows["paper"]["parameters"]
    assert f"| the paper's network | {rows['paper']['parameters'] / 1e6:.2f} |" in text

    assert all((runs / f"{name}_seed1.log").stat().st_size > 0 for name in ("paper", "heads"))

    # What a config begins with stands above them, as it is.
    assert ablate.start_of(config) is None
    begun = tmp_path / "begun.yaml"
    begun.write_text(CONFIG.replace("model:", f"model:\n  init_from: {runs / 'heads_seed1' / 'model.safetensors'}"))
    only = ["--config", begun, "--runs", runs, "--scenes", "2", "--variants", "heads", "--only-score"]
    assert ablate.main(list(map(str, only))) == 0, capsys.readouterr().err
    start, heads = json.loads((runs / "ablation.json").read_text())
    assert (start["variant"], start["samples"]) == ("start", 0) and start["scores"] == heads["scores"]

    # Complete runs are not trained again; what was never run is left out.
    before = (runs / "paper_seed1" / "model.safetensors").stat().st_mtime_ns
    options[options.index("paper,heads")] = "paper,skip"
    assert ablate.main([*map(str, options), "--only-score"]) == 0
    assert (runs / "paper_seed1" / "model.safetensors").stat().st_mtime_ns == before
    assert not (runs / "skip_seed1").exists() and "skip" not in page.read_text() and "heads" not in page.read_text()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--variants", "paper,skips"], "unknown variant 'skips'"),
        (["--variants", ","], "no variant given"),
        (["--variants", "network"], "unknown variant 'network'"),
        (["--seeds", "0"], "--seeds 0"),
        (["--jobs", "0"], "--jobs 0"),
        (["--only-score", "--trainer.max_steps=3"], "--trainer.max_steps=3"),
        (["--only-score"], "no complete run"),
        (["--markdown", "nowhere.md"], "nowhere.md"),
    ],
)
def test_refusals_are_one_sentence(
    ablate: ModuleType, options: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ablate.main(["--runs", str(tmp_path / "runs"), *options]) == 2
    said = capsys.readouterr().err.strip()
    assert named in said and len(said.splitlines()) == 1


def test_seeds_are_averaged_with_their_range(ablate: ModuleType) -> None:
    scores = (
        dict.fromkeys(ablate.FIGURES, 0.4) | {"epe": 1.0, "ause": 0.2, "rho": None, "occlusion_auc": 0.8},
        dict.fromkeys(ablate.FIGURES, 0.4),
    )
    row = ablate.Row("paper", "label", 2_700_000, 6_300_000_000, 53.2, 1000, 2.5, scores)
    line = ablate.table([row], 8).splitlines()[2]
    assert line.startswith("| label | 2.70 | 6.30 | 53 | 1,000 | 2 | 0.70 [0.40, 1.00] | 0.300 [0.200, 0.400] | 0.40 |")
    assert line.endswith("| 0.60 [0.40, 0.80] | 0.4 [0.4, 0.4] | 0.40 [0.40, 0.40] | 0.4 [0.4, 0.4] |")


def test_groups_stand_for_their_variants(ablate: ModuleType) -> None:
    assert ablate.chosen("heads,networks") == ["heads", *(name for name in ablate.NETWORKS if name != "heads")]
    assert ablate.chosen("networks,recipes") == list(ablate.VARIANTS)


@pytest.mark.parametrize(
    "name", ["paper", "skip_heads", "skip_correlation", "general", "no_l1", "half_rate", "no_average"]
)
def test_training_takes_the_options_of_a_variant(
    ablate: ModuleType, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A misspelt one would be noticed hours after the command was given."""
    from ajna.training.cli import main

    config = tmp_path / "tiny.yaml"
    config.write_text(CONFIG)
    with pytest.raises(SystemExit) as end:
        main(["fit", f"--config={config}", *ablate.options_of(name), "--print_config"])
    said = capsys.readouterr()
    assert not end.value.code, said.err
    for key, value in ablate.VARIANTS[name][1].items():
        part = yaml.safe_load(said.out)
        for step in key.split("."):
            part = part.get("init_args", part)[step]
        assert part == value, key
