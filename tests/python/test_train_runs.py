# SPDX-License-Identifier: MIT
"""The real training script on small data sets: the paper's two stages, resume, kills, several processes, bad data."""

from __future__ import annotations

import csv
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")
pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna.nn import load_checkpoint

TRAIN = Path(__file__).resolve().parents[2] / "train"

if not (TRAIN / "train.py").is_file():
    pytest.skip("the training script is not part of the wheel and the source tree is absent", allow_module_level=True)

CONFIG = """
name: tiny
save_every: 2
threads: 1
trainer: {max_epochs: 3, check_val_every_n_epoch: 1, log_every_n_steps: 1, enable_progress_bar: false}
model:
  net: {width: 4}
  flow_scale: 2.0
  guidance: {motion_energy: false, heads_weight: 0.0}
  optim: {warmup_steps: 2}
data:
  class_path: ajna.training.DatasetData
  init_args: {dataset: chairs2, batch: 4, size: [16, 8], fit: native, prefetch: 1, val_batch: 2}
"""


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"loaded_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


trees = load(Path(__file__).with_name("data_trees.py"))
fit = load(TRAIN / "train.py").main


def chairs2(root: Path, count: int = 14) -> Path:
    trees.chairs2(trees.Tree(root), tuple(f"{n:07d}" for n in range(count)), ("0000100", "0000101", "0000102"))
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return chairs2(tmp_path_factory.mktemp("data") / "FlyingChairs2")


@pytest.fixture(scope="module")
def arguments(root: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    config = tmp_path_factory.mktemp("config") / "tiny.yaml"
    config.write_text(CONFIG)
    return ["fit", "--config", str(config), "--data.root", str(root)]


@pytest.fixture(scope="module")
def straight(arguments: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was not interrupted: three epochs of three steps."""
    runs = tmp_path_factory.mktemp("runs")
    assert fit([*arguments, "--runs", str(runs)]) == 0
    return runs / "tiny"


def state_of(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def rows_of(folder: Path) -> list[dict[str, str]]:
    return [row for path in sorted(folder.glob("csv/*/metrics.csv")) for row in csv.DictReader(path.open())]


def child(code: str, *args: str, timeout: int = 900) -> subprocess.CompletedProcess[str]:
    # pytest's own path, so that the package under test is the one that the child imports.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code, *args]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout, check=False)


# --- the paper's two stages ----------------------------------------------------------------------------------------


def test_the_configs_hold_the_numbers_of_the_paper(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for stage in ("chairs2", "things3d"):
        with pytest.raises(SystemExit) as ended:
            fit(["fit", "--config", str(TRAIN / "configs" / f"{stage}.yaml"), "--print_config"])
        assert ended.value.code == 0
        shown[stage] = config = yaml.safe_load(capsys.readouterr().out)
        data = config["data"]["init_args"]
        assert (data["dataset"], data["batch"], list(data["size"])) == (stage, 32, [320, 240])
        loss = config["model"]["loss"]
        assert [loss[name] for name in ("f", "h", "g", "lam")] == ["l1", "inv_softplus", "softplus", 1.0]
        assert loss["l1_steps"] == loss["blend_steps"] == loss["l1_share"] == 0
        optim = config["model"]["optim"]
        assert (optim["optimizer"], optim["schedule"], optim["warmup_steps"]) == ("adam", "constant", 0)
        assert config["model"]["net"] is None, "the paper's network is the default"
    numbers = {name: (c["trainer"]["max_epochs"], c["model"]["optim"]["lr"]) for name, c in shown.items()}
    assert numbers == {"chairs2": (400, 1e-4), "things3d": (50, 1e-5)}
    assert shown["things3d"]["model"]["init_from"] == "runs/chairs2/model.safetensors"


def test_the_two_stages_run_from_pack_to_torchscript(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for split in ("train", "val"):
        done = load(TRAIN / "pack.py").main(
            ["--dataset", "chairs2", "--root", str(root), "--set", f"split={split}", "--out", f"packs/{split}"]
        )
        assert done == 0
    quick = ["--trainer.max_epochs", "1", "--trainer.enable_progress_bar", "false", "--model.net.width", "4"]
    quick += ["--data.batch", "4", "--data.size", "[16, 8]"]
    packed = ["--data.dataset", "packed", "--data.root", "packs/train", "--data.val_root", "packs/val"]
    assert fit(["fit", "--config", str(TRAIN / "configs/chairs2.yaml"), *quick, *packed]) == 0
    first, metadata = load_checkpoint("runs/chairs2/model.safetensors")
    assert metadata["flow_scale"] == 2.0 and metadata["provenance"]["samples"] == "12"
    assert "FlyingChairs2, 14 pairs in batches of 4" in metadata["provenance"]["data"]
    assert float(metadata["provenance"]["val_epe"]) > 0, "validated at its end"

    things = trees.make("things3d", tmp_path / "FlyingThings3D").root
    stage2 = ["fit", "--config", str(TRAIN / "configs/things3d.yaml"), *quick, "--data.root", str(things)]
    assert fit([*stage2, "--model.init_from", "runs/chairs3/model.safetensors"]) == 2
    assert "runs/chairs3/model.safetensors" in capsys.readouterr().err
    assert fit(stage2) == 0
    second, metadata = load_checkpoint("runs/things3d/best.safetensors")
    assert "FlyingThings3D, 4 pairs" in metadata["provenance"]["data"]
    # One Adam step of 1e-5 from the first stage's weights.
    steps = [(a - b).abs().max() for a, b in zip(first.parameters(), second.parameters(), strict=True)]
    assert 1e-6 < max(steps) < 1.1e-5

    evaluate = load(TRAIN / "evaluate.py").main
    assert evaluate(["--dataset", "things3d", "--root", str(things), "--model", "runs/things3d/best.safetensors"]) == 0
    export = load(TRAIN / "export.py").main
    assert export(["runs/things3d", "--out", "model.pt"]) == 0
    assert "max abs difference to the network" in capsys.readouterr().out
    frames = [torch.zeros(1, 3, 16, 16, dtype=torch.uint8)] * 2
    assert torch.jit.load("model.pt").predict(*frames)[0].shape == (1, 2, 16, 16)
    assert export(["packs", "--out", "other.pt"]) == 2 and not Path("other.pt").exists()
    assert "run folder 'packs' holds no best.safetensors" in capsys.readouterr().err


# --- a run ---------------------------------------------------------------------------------------------------------


def test_epochs_are_counted_and_validated(straight: Path) -> None:
    rows = rows_of(straight)
    assert [float(row["epoch"]) for row in rows if row["train/loss"]] == pytest.approx([n / 3 for n in range(1, 10)])
    assert [float(row["epoch"]) for row in rows if row["val/epe"]] == [1, 2, 3]
    assert {row["train/lr"] for row in rows} - {""} and all(row["val/expected_ratio"] for row in rows if row["val/epe"])
    assert sorted(p.name for p in (straight / "pictures").iterdir()) == [f"step-000000{n}.png" for n in (3, 6, 9)]
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    board = events.EventAccumulator(str(straight / "tensorboard")).Reload()
    assert [event.step for event in board.Images("val/pairs")] == [3, 6, 9] and "train/loss" in board.Tags()["scalars"]
    assert state_of(straight)["ajna"]["steps_done"] == 9 and state_of(straight)["ajna"]["samples_done"] == 36


def test_the_bar_goes_on_where_the_run_was(
    arguments: list[str], straight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    shutil.copytree(straight, tmp_path / "tiny")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    mine = [*arguments, "--runs", str(tmp_path), "--resume", "true", "--trainer.max_epochs", "7"]
    assert fit([*mine, "--trainer.enable_progress_bar", "true"]) == 0
    shown = capsys.readouterr().out
    last = re.findall(r"training: +(\d+)%.*?(\d+)/(\d+) \[\d+:\d+<(\d+:\d+),(.*?)\]", shown)
    assert [line[:3] for line in last][-1] == ("95", "20", "21") or last[-1][:3] == ("100", "21", "21")
    assert "train/samples_per_s=" in shown and int(last[0][1]) > 9, "begins behind the steps done before"


# Killed after a step in the middle of the second epoch; while last.ckpt is half written.
KILLS = {
    "in an epoch": "from ajna.training.run_folder import RunFolder as kind; hook = 'on_train_batch_end'; at = 6",
    "in a write": "from ajna.training.run_folder import AtomicCheckpointIO as kind; hook = 'save_checkpoint'; at = 4",
}


@pytest.mark.parametrize("moment", KILLS)
def test_a_killed_and_resumed_run_equals_a_straight_one_bit_for_bit(
    arguments: list[str], straight: Path, tmp_path: Path, moment: str
) -> None:
    kill = (
        "import os, signal, sys, torch\n"
        "from pathlib import Path\n"
        "from ajna.training import cli\n"
        f"{KILLS[moment]}\n"
        "before, calls = getattr(kind, hook), []\n"
        "def killing(self, *args, **options):\n"
        "    calls.append(1)\n"
        "    if len(calls) == at and hook == 'save_checkpoint':\n"
        "        def half(checkpoint, path):\n"
        "            Path(path).write_bytes(b'PK' * 1000)\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        torch.save = half\n"
        "    elif len(calls) == at:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return before(self, *args, **options)\n"
        "setattr(kind, hook, killing)\n"
        "cli.main(sys.argv[1:])\n"
    )
    mine = [*arguments, "--runs", str(tmp_path)]
    killed = child(kill, *mine)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    reached = state_of(tmp_path / "tiny")["ajna"]["steps_done"]
    assert reached == 4, "the last whole checkpoint, at most save_every steps back"
    if moment == "in a write":
        assert any(path.name.startswith(".last.ckpt") for path in (tmp_path / "tiny/checkpoints").iterdir())
    assert fit([*mine, "--resume", "true", "--data.workers", "3"]) == 0
    assert sorted(p.name for p in (tmp_path / "tiny/checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]
    ours, theirs = state_of(tmp_path / "tiny"), state_of(straight)
    for name, value in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], value), name
    for key, value in theirs["optimizer_states"][0]["state"].items():
        assert torch.equal(ours["optimizer_states"][0]["state"][key]["exp_avg"], value["exp_avg"])
    assert {**ours["ajna"], "seconds": 0} == {**theirs["ajna"], "seconds": 0}
    last = {row["step"]: row["val/epe"] for row in rows_of(tmp_path / "tiny") if row["val/epe"]}
    assert last == {row["step"]: row["val/epe"] for row in rows_of(straight) if row["val/epe"]}


def two_processes(arguments: list[str], folder: Path, step: str) -> list[dict[str, Any]]:
    """An epoch of a run of two processes whose training step is `step`; their notes and weights."""
    script = folder / "train.py"  # the second process runs the file of the first again
    script.write_text(
        "import sys, torch\n"
        "from ajna.training import cli, module\n"
        "from pathlib import Path\n"
        "module.FlowModule.note = property(lambda self: self.__dict__.setdefault('noted', {}))\n"
        "original = module.FlowModule.training_step\n"
        f"{step}"
        "module.FlowModule.training_step = step\n"
        "def end(self):\n"
        "    found = {**self.note, 'net': [p.data for p in self.net.parameters()], 'skipped': self.skipped,\n"
        "             'epe': float(self.trainer.callback_metrics['val/epe'])}\n"
        f"    torch.save(found, Path({str(folder)!r}) / f'rank{{self.global_rank}}.pt')\n"
        "module.FlowModule.on_train_end = end\n"
        "sys.exit(cli.main(sys.argv[1:]))\n"
    )
    two = ["--trainer.accelerator", "cpu", "--trainer.devices", "2", "--trainer.strategy", "ddp"]
    two += ["--trainer.max_epochs", "1", "--runs", str(folder)]
    done = child(f"import runpy, sys; sys.argv[0] = {str(script)!r}; runpy.run_path(sys.argv[0])", *arguments, *two)
    assert done.returncode == 0, done.stderr[-3000:]
    return [torch.load(folder / f"rank{rank}.pt") for rank in (0, 1)]


def test_two_processes_learn_the_same_from_different_pairs(arguments: list[str], tmp_path: Path) -> None:
    noted = (
        "def step(self, batch, index):\n"
        "    self.note.setdefault('names', []).extend(batch['name'])\n"
        "    original(self, batch, index)\n"
        "    self.note['grad'] = [p.grad.clone() for p in self.net.parameters()]\n"
    )
    zero, one = two_processes(arguments, tmp_path, noted)
    assert len(zero["names"]) == len(one["names"]) == 6 and len({*zero["names"], *one["names"]}) == 12
    for key in ("grad", "net"):
        assert all(torch.equal(a, b) for a, b in zip(zero[key], one[key], strict=True)), key
    assert zero["epe"] == one["epe"], "scores are those of all validation pairs"
    assert any(g.abs().sum() > 0 for g in zero["grad"])
    state = state_of(tmp_path / "tiny")
    assert state["ajna"]["samples_done"] == 12
    assert not fit([*arguments, "--runs", str(tmp_path), "--trainer.max_epochs", "2", "--resume", "true"]), (
        "goes on with one process"
    )


def test_two_processes_leave_out_a_step_that_fails_in_one(arguments: list[str], tmp_path: Path) -> None:
    spoiled = (
        "def step(self, batch, index):\n"
        "    before = [p.detach().clone() for p in self.net.parameters()]\n"
        "    if self.steps_done == 1 and self.global_rank == 1:\n"
        "        batch = {**batch, 'flow': batch['flow'] * float('nan')}\n"
        "    original(self, batch, index)\n"
        "    moved = any(not torch.equal(a, b) for a, b in zip(before, self.net.parameters()))\n"
        "    self.note.setdefault('moved', []).append(moved)\n"
    )
    zero, one = two_processes(arguments, tmp_path, spoiled)
    assert zero["moved"] == one["moved"] == [True, False, True]
    assert zero["skipped"] == one["skipped"] == 1
    assert all(torch.equal(a, b) and a.isfinite().all() for a, b in zip(zero["net"], one["net"], strict=True))


# --- what goes wrong -----------------------------------------------------------------------------------------------


def write_flo(path: Path, flow: np.ndarray) -> None:
    trees.write_flo(path, flow.astype(np.float32), np.ones(flow.shape[:2], bool))


DAMAGE = {
    "corrupt image": ("train/0000002-img_0.png", lambda p: p.write_bytes(p.read_bytes()[:60])),
    "flow of another size": ("train/0000002-flow_01.flo", lambda p: write_flo(p, np.zeros((5, 7, 2)))),
    "NaN flow": ("train/0000002-flow_01.flo", lambda p: write_flo(p, np.full((12, 20, 2), np.nan))),
    "empty folder": ("train", lambda p: [file.unlink() for file in p.iterdir()]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_bad_data_is_named_or_skipped(
    arguments: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str], damage: str
) -> None:
    place, act = DAMAGE[damage]
    bad = chairs2(tmp_path / "data", 8) / place
    act(bad)
    mine = [*arguments, "--runs", str(tmp_path), "--data.root", str(tmp_path / "data"), "--trainer.max_epochs", "1"]
    assert fit(mine) == 2
    error = capfd.readouterr().err
    assert str(bad) in error and "Traceback" not in error
    assert not list(tmp_path.rglob("*.ckpt"))
    assert len([line for line in error.splitlines() if line.startswith("train.py: ")]) == 1
    if damage == "empty folder":
        assert fit([*mine, "--skip-bad"]) == 2, "nothing is left to learn from"
        return
    assert fit([*mine, "--skip-bad"]) == 0
    (line,) = (tmp_path / "tiny/bad_samples.txt").read_text().splitlines()
    assert line.startswith("0000002: ") and str(bad) in line
    assert f"bad sample {line}" in capfd.readouterr().err
    assert [row["train/bad_samples"] for row in rows_of(tmp_path / "tiny") if row["train/bad_samples"]][-1] == "1.0"


def test_a_run_that_blows_up_ends_with_its_batch(
    arguments: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    wild = ["--model.optim.lr", "1e30", "--model.optim.warmup_steps", "0", "--model.optim.max_bad_steps", "2"]
    assert fit([*arguments, "--runs", str(tmp_path), *wild]) == 2
    error = capfd.readouterr().err
    found = re.search(r"not finite for 2 steps in a row \(step \d+, its batch is in '(.*)'\)", error)
    assert found and "Traceback" not in error
    with np.load(found[1]) as batch:
        assert batch["frame1"].shape == (4, 3, 8, 16) and batch["frame1"].dtype == np.uint8
        assert not (np.isfinite(batch["loss"]) and np.isfinite(batch["gradient_norm"]))
        assert len(set(batch["name"].tolist())) == 4
    assert not list(tmp_path.rglob(".*.npz"))


@pytest.mark.parametrize("preset", ["authors", "standard"])
def test_augmented_pairs_are_learned_from(root: Path, tmp_path: Path, preset: str) -> None:
    """With the real augmentation, backward flow included: what is trained on differs, what is validated does not."""
    config = tmp_path / "augmented.yaml"
    data = f"fit: native, options: {{backward: true}}, augment: {{preset: {preset}}},"
    config.write_text(CONFIG.replace("fit: native,", data))
    arguments = ["fit", "--config", str(config), "--data.root", str(root), "--runs", str(tmp_path)]
    assert fit(arguments) == 0
    plain = yaml.safe_load((tmp_path / "tiny" / "config.yaml").read_text())
    assert plain["data"]["init_args"]["augment"] == {"preset": preset}
    rows = rows_of(tmp_path / "tiny")
    assert [float(row["val/epe"]) > 0 for row in rows if row["val/epe"]] == [True] * 3
    assert all(np.isfinite(float(row["train/loss"])) for row in rows if row["train/loss"])
    assert state_of(tmp_path / "tiny")["ajna"]["skipped"] == 0
    model = load_checkpoint(tmp_path / "tiny" / "model.safetensors")[1]
    assert f"augmented: preset={preset}" in str(model)
    assert fit([*arguments, "--trainer.max_epochs", "4", "--resume", "true"]) == 0


def test_another_training_set_does_not_resume(
    arguments: list[str], straight: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    mine = [*arguments, "--runs", str(straight.parent), "--resume", "true", "--trainer.max_epochs", "5"]
    assert fit([*mine, "--data.seed", "2"]) == 2
    assert "begun with seed = 1 of the training data, not 2" in capfd.readouterr().err
    assert fit([*mine, "--trainer.precision", "16-mixed"]) == 2
    assert "precision = 16-mixed: give bf16-mixed or 32-true" in capfd.readouterr().err


def test_throughput_tells_reading_from_the_step(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert fit(["throughput", *arguments[1:]]) == 0
    header, line = capsys.readouterr().out.splitlines()[-2:]
    assert header.split()[:4] == ["stage", "read", "step", "both"] and "batch 4 from chairs2" in line
    assert all(float(number) > 0 for number in line.split()[-3:])
