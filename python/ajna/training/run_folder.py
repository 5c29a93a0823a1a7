# SPDX-License-Identifier: MIT
"""What a run leaves behind: checkpoints that survive a kill, and the model file that others load."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ajna.nn import save_checkpoint
from ajna.training.module import FlowModule
from ajna.training.run_files import atomic_path


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, written beside the old one and renamed: a kill always leaves a whole file."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        with atomic_path(path) as temporary:
            torch.save(checkpoint, temporary)


class RunFolder(pl.Callback):
    """Keeps last.ckpt, best.ckpt (lowest val/epe), model.safetensors and best.safetensors in ``folder``.

    Args:
        folder: the run's folder.
        name: the model's name in its checkpoints.
        every: steps between two ``last.ckpt``.
    """

    def __init__(self, folder: str | os.PathLike[str], name: str, every: int) -> None:
        if every < 1:
            raise ValueError(f"training option save_every = {every}: give at least 1")
        self.folder, self.name, self.every = Path(folder), name, every
        self.best = float("inf")

    @property
    def last(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best = state_dict["best"]

    def on_fit_start(self, trainer: pl.Trainer, pl_module: Any) -> None:
        pl_module.failure_folder = self.folder
        if trainer.is_global_zero:
            for part in ("checkpoints", "pictures"):  # half-written files of a run that was killed
                for leftover in (self.folder / part).glob(".*"):
                    leftover.unlink()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, *args: Any) -> None:
        if pl_module.steps_done % self.every == 0:
            trainer.save_checkpoint(self.last, weights_only=False)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FlowModule)
        if trainer.state.fn != "fit" or trainer.sanity_checking:
            return
        error = float(trainer.callback_metrics["val/epe"])
        self._save_model(trainer, pl_module, "model")
        if error < self.best:
            self.best = error
            self._save_model(trainer, pl_module, "best")
            trainer.save_checkpoint(self.folder / "checkpoints" / "best.ckpt", weights_only=False)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FlowModule)
        trainer.save_checkpoint(self.last, weights_only=False)
        self._save_model(trainer, pl_module, "model")

    def _save_model(self, trainer: pl.Trainer, module: FlowModule, stem: str) -> None:
        if not trainer.is_global_zero:
            return
        scores = {
            k.replace("/", "_"): f"{float(v):.5g}" for k, v in trainer.callback_metrics.items() if k[:4] == "val/"
        }
        data = getattr(trainer, "datamodule", None)
        provenance = {**module.provenance(), **scores, "data": data.describe() if data is not None else "unknown"}
        net = module.ema
        if module.memory_format is not torch.contiguous_format:
            # The file holds plain contiguous tensors; the network in training keeps its format.
            net = _contiguous_copy(net)
        self.folder.mkdir(parents=True, exist_ok=True)
        save_checkpoint(self.folder / f"{stem}.safetensors", net, self.name, module.loss, module.flow_scale, provenance)


def _contiguous_copy(net: Any) -> Any:
    import copy

    return copy.deepcopy(net).to(device="cpu", memory_format=torch.contiguous_format)
