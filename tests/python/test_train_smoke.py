# SPDX-License-Identifier: MIT
"""The real training script on a CPU at toy size: run, resume, kill, refuse. And the parts it stands on."""

from __future__ import annotations

import csv
import importlib.util
import math
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")

from ajna.losses import UncertaintyLoss
from ajna.nn import load_checkpoint, save_checkpoint
from ajna.training import FlowModule, NetOptions

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "train" / "train.py"

if not SCRIPT.is_file():
    pytest.skip("the training script is not part of the wheel and the source tree is absent", allow_module_level=True)

CONFIG = """
name: tiny
save_every: 3
threads: 1
trainer:
  max_steps: 10
  precision: bf16-mixed
  log_every_n_steps: 2
  val_check_interval: 5
  enable_progress_bar: false
model:
  net: {width: 4}
  flow_scale: 4.0
  loss: {l1_steps: 2, blend_steps: 4}
  optim: {warmup_steps: 2}
data:
  scene: {bank_size: 4, texture_size: 32, layers: 2}
  stages:
    - {from_step: 0, height: 32, width: 48, batch: 2, motion: 0.5, scene: {layers: 0}}
    - {from_step: 3, height: 32, width: 32, batch: 2, reuse: 2, pool: 2}
  validation: {batches: 2, batch: 2, height: 48, width: 64}
"""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("train_script", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def straight(script: ModuleType, config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was not interrupted."""
    runs = tmp_path_factory.mktemp("runs")
    assert script.main(["fit", "--config", str(config), "--runs", str(runs)]) == 0
    return runs / "tiny"


def state_of(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_a_run_leaves_config_logs_checkpoints_pictures_and_the_model(straight: Path) -> None:
    effective = (straight / "config.yaml").read_text()
    assert "max_steps: 10" in effective and "ema_decay: 0.999" in effective, "defaults are spelt out, too"
    rows = list(csv.DictReader((straight / "csv" / "version_0" / "metrics.csv").open()))
    scores = [row for row in rows if row["val/epe"]]
    assert len(scores) == 2
    for name in ("epe", "epe_ratio", "ause", "spearman", "loss"):
        assert math.isfinite(float(scores[-1][f"val/{name}"]))
    assert any(row["train/samples_per_s"] for row in rows)
    assert list((straight / "tensorboard").glob("events*"))
    assert sorted(p.name for p in (straight / "pictures").iterdir()) == ["step-0000005.png", "step-0000010.png"]
    assert sorted(p.name for p in (straight / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert not [p for p in straight.rglob("*") if p.name.startswith(".")], "no temporary file stays behind"


def test_the_model_file_holds_the_averaged_network_and_where_it_comes_from(straight: Path) -> None:
    net, metadata = load_checkpoint(straight / "model.safetensors")
    state = state_of(straight)["state_dict"]
    for name, value in net.state_dict().items():
        assert torch.equal(value, state[f"ema.{name}"]), name
    assert any(not torch.equal(state[f"ema.{n}"], state[f"net.{n}"]) for n, _ in net.named_parameters())
    assert metadata["name"] == "tiny" and metadata["flow_scale"] == 4.0
    provenance = metadata["provenance"]
    assert (provenance["steps"], provenance["samples"]) == ("10", "20")
    assert "synthetic scenes" in provenance["data"] and float(provenance["val_epe"]) > 0
    assert load_checkpoint(straight / "best.safetensors")[0].config == net.config


# Steps 4, 8: inside a round's first turn, and inside its second.
@pytest.mark.parametrize("stop", [4, 8])
def test_a_killed_and_resumed_run_equals_a_straight_one_bit_for_bit(
    script: ModuleType, config: Path, straight: Path, tmp_path: Path, stop: int
) -> None:
    arguments = ["fit", "--config", str(config), "--runs", str(tmp_path), "--save_every", str(stop)]
    kill = (
        "import os, sys\n"
        "from ajna.training import cli, run_folder\n"
        "save = run_folder.RunFolder.on_train_batch_end\n"
        "def hook(self, trainer, module, *rest):\n"
        "    save(self, trainer, module, *rest)\n"
        f"    if module.steps_done == {stop} + 1: os._exit(9)\n"
        "run_folder.RunFolder.on_train_batch_end = hook\n"
        "cli.main(sys.argv[1:])\n"
    )
    # pytest's own path, so that the package under test is the one that the child imports.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    killed = subprocess.run([sys.executable, "-c", kill, *arguments], env=environment, capture_output=True, text=True)
    assert killed.returncode == 9, killed.stderr
    assert state_of(tmp_path / "tiny")["ajna"]["steps_done"] == stop
    assert script.main(arguments) == 2, "an existing run is not overwritten"
    assert script.main([*arguments, "--resume", "true"]) == 0
    mine, theirs = state_of(tmp_path / "tiny"), state_of(straight)
    for name, value in theirs["state_dict"].items():
        assert torch.equal(mine["state_dict"][name], value), name
    for name in ("steps_done", "samples_done", "skipped"):
        assert mine["ajna"][name] == theirs["ajna"][name]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (["--model.flow_scal", "2"], "flow_scal"),
        (["--model.optim.lr", "-1"], "lr = -1"),
        (["--model.loss.h", "inv_sofplus"], "inv_softplus"),
        (["--data.scene", "{layer: 3}"], "layers"),
        (["--data.stages", "[{from_step: 5, height: 32, width: 32, batch: 1}]"], "from_step"),
        (["--data.stages", "[{from_step: 0, height: 32, width: 32, batch: 1, moton: 2}]"], "moton"),
        (["--trainer.max_steps", "-1"], "max_steps"),
        (["--config", "absent.yaml"], "absent.yaml"),
    ],
)
def test_unusable_options_are_refused_by_name(
    script: ModuleType, config: Path, tmp_path: Path, capfd: Any, option: list[str], message: str
) -> None:
    try:
        code = script.main(["fit", "--config", str(config), "--runs", str(tmp_path), *option])
    except SystemExit as refused:  # the parser's own way
        code = refused.code
    assert code == 2
    error = capfd.readouterr().err
    assert message in error and "Traceback" not in error
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.parametrize(
    "name", ["synthetic", "synthetic_continue", "synthetic_mix", "synthetic_tasks", "synthetic_long", "ablation"]
)
def test_the_configs_are_valid(name: str) -> None:
    from ajna.training.cli import TrainCLI

    path = REPOSITORY / "train" / "configs" / f"{name}.yaml"
    small = ["--model.net.width", "2", "--model.init_from", "null"]
    assert TrainCLI(["--config", str(path), *small], run=False).datamodule.stages


def test_throughput_prints_a_line_per_stage(script: ModuleType, config: Path, capsys: Any) -> None:
    assert script.main(["throughput", "--config", str(config)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len([line for line in lines if "from step" in line]) == 2
    assert all(float(number) > 0 for number in lines[-1].split()[-3:])


def test_a_network_grows_from_a_smaller_one(straight: Path) -> None:
    path = str(straight / "model.safetensors")
    small = FlowModule(NetOptions(width=4), flow_scale=4.0, init_from=path)
    frames = torch.randint(0, 256, (2, 1, 3, 64, 64), dtype=torch.uint8)
    everything = {"scale_heads": True, "correlation_radius": 2, "skip_connections": True}
    for parts in (*({name: value} for name, value in everything.items()), everything):
        net = NetOptions(width=4, **parts)
        with pytest.raises(ValueError, match="grow: true"):
            FlowModule(net, flow_scale=4.0, init_from=path)
        grown = FlowModule(net, flow_scale=4.0, init_from=path, grow=True)
        # In training mode: a norm over new layers must not disturb the old ones either.
        assert torch.allclose(grown.net(grown._input(*frames)), small.net(small._input(*frames)), atol=1e-6)
        assert torch.allclose(grown(*frames), small(*frames), atol=1e-6)
        loss = grown.net(grown._input(*frames)).square().mean()
        loss.backward()
        for part in {name.split(".")[0] for name, _ in grown.net.named_parameters()} - {"encoder", "decoder"}:
            added = [parameter for name, parameter in grown.net.named_parameters() if name.startswith(part)]
            assert any(parameter.grad is not None and parameter.grad.abs().max() > 0 for parameter in added), part
    with pytest.raises(ValueError, match="width=4"):
        FlowModule(NetOptions(width=8), flow_scale=4.0, init_from=path, grow=True)


def test_a_network_does_not_shrink(straight: Path, tmp_path: Path) -> None:
    net = NetOptions(width=4, skip_connections=True).build()
    path = str(tmp_path / "skips.safetensors")
    save_checkpoint(path, net, name="skips", loss=UncertaintyLoss(), flow_scale=4.0)
    with pytest.raises(ValueError, match="give net options that agree"):
        FlowModule(NetOptions(width=4), flow_scale=4.0, init_from=path, grow=True)


def test_init_from_a_checkpoint_must_agree(straight: Path) -> None:
    path = str(straight / "model.safetensors")
    module = FlowModule(NetOptions(width=4), flow_scale=4.0, init_from=path)
    loaded = load_checkpoint(path)[0]
    assert all(torch.equal(a, b) for a, b in zip(module.net.parameters(), loaded.parameters(), strict=True))
    with pytest.raises(ValueError, match="width=4"):
        FlowModule(NetOptions(width=8), flow_scale=4.0, init_from=path)
    with pytest.raises(ValueError, match="flow_scale"):
        FlowModule(NetOptions(width=4), flow_scale=1.0, init_from=path)
