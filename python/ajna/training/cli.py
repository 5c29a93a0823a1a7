# SPDX-License-Identifier: MIT
"""The training command: ``fit``, ``validate`` and ``throughput`` from one YAML config, every key also an option."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from ajna.training.datasets import DatasetData
from ajna.training.failure import NonFiniteLoss
from ajna.training.module import FlowModule
from ajna.training.progress import BadSamples, Pictures, StepProgressBar, Throughput
from ajna.training.run_files import atomic_path
from ajna.training.run_folder import AtomicCheckpointIO, RunFolder
from ajna.training.throughput import throughput

_TRAINER_DEFAULTS: dict[str, Any] = {
    "max_epochs": -1,  # steps are what counts
    "check_val_every_n_epoch": None,
    "num_sanity_val_steps": 0,
    "use_distributed_sampler": False,
    "enable_checkpointing": False,  # RunFolder does it
    "enable_model_summary": False,
}


class TrainCLI(LightningCLI):
    """Lightning's command line with a run folder: runs/<name> holds config, logs, checkpoints and the model."""

    def __init__(self, args: Sequence[str], run: bool = True) -> None:
        super().__init__(
            FlowModule,
            LightningDataModule,
            subclass_mode_data=True,  # data.class_path: ajna.training.DatasetData, or SyntheticData if not given
            args=list(args),
            run=run,
            seed_everything_default=1,
            trainer_defaults=_TRAINER_DEFAULTS,
            save_config_callback=None,
            load_from_checkpoint_support=False,
            # A misspelt option must not be taken for the one that it abbreviates.
            parser_kwargs={"allow_abbrev": False, **{name: {"allow_abbrev": False} for name in self.subcommands()}},
        )

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {name: {"model", "datamodule"} for name in ("fit", "validate")}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.set_defaults({"data": {"class_path": "ajna.training.SyntheticData"}})
        parser.add_argument("--name", type=str, default="synthetic", help="name of the run and of the model")
        parser.add_argument("--runs", type=str, default="runs", help="folder of the run folders")
        parser.add_argument("--resume", type=bool, default=False, help="go on from runs/<name>/checkpoints/last.ckpt")
        parser.add_argument("--save_every", type=int, default=1000, help="steps between two last.ckpt")
        parser.add_argument("--pictures", type=int, default=4, help="validation pairs drawn after each validation")
        parser.add_argument("--repeats", type=int, default=10, help="throughput only: batches measured per figure")
        parser.add_argument("--threads", type=int | None, default=None, help="CPU threads of the network")

    @property
    def folder(self) -> Path:
        return Path(self._get(self.config, "runs")) / self._get(self.config, "name")

    @property
    def last_checkpoint(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    def before_instantiate_classes(self) -> None:
        threads = self._get(self.config, "threads")
        if threads is not None:
            if threads < 1:
                raise ValueError(f"training option threads = {threads}: give at least 1")
            torch.set_num_threads(threads)
        precision = str(self._get(self.config, "trainer").get("precision"))
        if precision in ("16", "16-mixed", "16-true"):
            raise ValueError(f"training option trainer.precision = {precision}: give bf16-mixed or 32-true")
        if self.subcommand != "fit" or self._get(self.config, "ckpt_path"):
            return
        exists = self.last_checkpoint.is_file()
        if exists and not self._get(self.config, "resume"):
            raise ValueError(
                f"run '{self.folder}' has a checkpoint already: give --resume true to go on, or another --name"
            )

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        if self.subcommand != "fit":
            return super().instantiate_trainer(logger=False, **kwargs)
        trainer = self._get(self.config_init, "trainer")
        kwargs["logger"] = [
            TensorBoardLogger(self.folder, name="tensorboard", version=""),
            CSVLogger(self.folder, name="csv"),  # one numbered folder per resume
        ]
        kwargs["plugins"] = [AtomicCheckpointIO()]
        kwargs["callbacks"] = [
            *(trainer.get("callbacks") or []),
            Throughput(trainer.get("log_every_n_steps") or 50),
            BadSamples(self.folder),
            *([] if trainer.get("enable_progress_bar") is False else [StepProgressBar()]),
            # Pictures first: RunFolder's files are then the last word on a validation.
            Pictures(self.folder / "pictures", self._get(self.config, "pictures")),
            RunFolder(self.folder, self._get(self.config, "name"), self._get(self.config, "save_every")),
        ]
        return super().instantiate_trainer(**kwargs)

    def before_fit(self) -> None:
        if isinstance(self.datamodule, DatasetData):
            self.datamodule.total_steps(self.trainer.max_epochs, self.trainer.max_steps)
        elif self.trainer.max_steps < 1:
            raise ValueError(f"training option trainer.max_steps = {self.trainer.max_steps}: give the steps to train")
        self._save_config()

    def _save_config(self) -> None:
        """The effective config, as runs/<name>/config.yaml; an earlier, different one is kept under a number."""
        config = self.config[self.subcommand]
        text = self._parser(self.subcommand).dump(config)
        target = self.folder / "config.yaml"
        if target.is_file():
            before = target.read_text(encoding="utf-8")
            if before != text:
                number = 1
                while (older := target.with_name(f"config.{number}.yaml")).exists():
                    number += 1
                target.rename(older)
        with atomic_path(target) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        arguments = super()._prepare_subcommand_kwargs(subcommand)
        if arguments.get("ckpt_path") is None and self._get(self.config, "resume"):
            if self.last_checkpoint.is_file():
                arguments["ckpt_path"] = str(self.last_checkpoint)
            elif subcommand != "fit":
                raise FileNotFoundError(f"checkpoint '{self.last_checkpoint}' does not exist: train first")
        return arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Run the training command; returns the exit code: 0, or 2 with one sentence on stderr for unusable input."""
    args = list(sys.argv[1:] if argv is None else argv)
    args = ["--data.skip_bad=true" if arg == "--skip-bad" else arg for arg in args]  # as train/pack.py has it
    # Advice that does not apply: the loaders are endless streams, made without workers.
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*LightningCLI's args parameter.*")
    warnings.filterwarnings("ignore", message=".*`isinstance\\(treespec, LeafSpec\\)`.*")
    warnings.filterwarnings("ignore", message=".*in eval mode at the start of training.*")  # the averaged network
    warnings.filterwarnings("ignore", message=".*you defined a `validation_step` but have no.*")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        if args[:1] == ["throughput"]:
            _throughput(args[1:])
        else:
            TrainCLI(args)
    except (ValueError, FileNotFoundError, PermissionError, MisconfigurationException, NonFiniteLoss) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2
    return 0


def _throughput(args: Sequence[str]) -> None:
    """``throughput --config FILE``: a table of samples per second."""
    cli = TrainCLI(args, run=False)
    precision = cli.config["trainer"].get("precision") or "32-true"
    data: Any = cli.datamodule
    device = cli.trainer.strategy.root_device
    place = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} threads"
    print(f"{'stage':<52}{data.source:>10}{'step':>10}{'both':>10}   samples/s, {place}")
    for row in throughput(cli.model.to(device), data, str(precision), cli.config["repeats"]):
        print(f"{row['stage']:<52}{row['samples']:>10.1f}{row['step']:>10.1f}{row['both']:>10.1f}")
