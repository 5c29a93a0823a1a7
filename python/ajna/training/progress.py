# SPDX-License-Identifier: MIT
"""Progress in steps and samples per second, and pictures of what the network sees."""

from __future__ import annotations

import itertools
import sys
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger

from ajna import viz
from ajna.training.run_files import atomic_path

#: what a validation picture shows of a pair, from left to right
PICTURE_COLUMNS = ("frame 1", "frame 2", "true flow", "flow", "expected error", "true error")


class Throughput(pl.Callback):
    """Logs train/samples_per_s, validation not counted; without a terminal it prints a line every ``every`` steps."""

    def __init__(self, every: int) -> None:
        self.every = max(every, 1)
        self._mark: tuple[float, int, int] | None = None
        self._begin: tuple[float, int] | None = None

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._mark = None

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, *args: Any) -> None:
        now, steps, samples = time.monotonic(), pl_module.steps_done, pl_module.samples_done
        self._begin = self._begin or (now, steps)
        if self._mark is None:
            self._mark = (now, steps, samples)
            return
        if steps % self.every:
            return
        rate = (samples - self._mark[2]) / max(now - self._mark[0], 1e-9)
        self._mark = (now, steps, samples)
        pl_module.log("train/samples_per_s", rate, prog_bar=True)
        if not sys.stderr.isatty() and trainer.is_global_zero:
            left = (now - self._begin[0]) / max(steps - self._begin[1], 1) * (trainer.max_steps - trainer.global_step)
            scores = trainer.callback_metrics
            shown = [f"{k} {float(scores[k]):.4g}" for k in ("train/loss", "train/epe", "val/epe") if k in scores]
            print(
                f"step {steps}/{trainer.max_steps}  {'  '.join(shown)}  {rate:.1f} samples/s  {_duration(left)} left",
                file=sys.stderr,
                flush=True,
            )


class BadSamples(pl.Callback):
    """Tells of bad samples that the data left out: a line each, ``train/bad_samples``, and ``bad_samples.txt``."""

    def __init__(self, folder: str | Path) -> None:
        self.folder, self._told = Path(folder), 0

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, *args: Any) -> None:
        self._tell(trainer)
        if self._told:
            pl_module.log("train/bad_samples", float(self._told))

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._tell(trainer)

    def _tell(self, trainer: pl.Trainer) -> None:
        bad = getattr(getattr(trainer, "datamodule", None), "bad", {})
        if len(bad) <= self._told:
            return
        lines = [f"{name}: {reason}" for name, reason in bad.items()]
        for line in lines[self._told :]:
            print(f"bad sample {line}", file=sys.stderr, flush=True)
        self._told = len(lines)
        rank = f"-rank-{trainer.global_rank}" if trainer.global_rank else ""
        with atomic_path(self.folder / f"bad_samples{rank}.txt") as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


class StepProgressBar(TQDMProgressBar):
    """One bar over all steps of the run with time left; silent without a terminal (Throughput prints lines there)."""

    def __init__(self, refresh_rate: int = 10) -> None:
        super().__init__(refresh_rate=refresh_rate if sys.stderr.isatty() else 0)

    @property
    def total_train_batches(self) -> int:
        return self.trainer.max_steps

    def on_train_epoch_start(self, trainer: pl.Trainer, *args: Any) -> None:
        super().on_train_epoch_start(trainer, *args)
        module: Any = trainer.lightning_module
        # After a resume, time left follows from this run's own pace.
        self.train_progress_bar.initial = self.train_progress_bar.n = module.steps_done
        self.train_progress_bar.set_description("training")


class Pictures(pl.Callback):
    """After each validation: frames, true flow, flow, expected error and true error of the first validation pairs, to
    TensorBoard and as ``pictures/step-*.png`` of the run folder. Flow and error scales are those of the ground truth;
    where it is unknown the true error is drawn as 0.
    """

    def __init__(self, folder: str | Path, count: int = 4) -> None:
        self.folder, self.count = Path(folder), count

    def on_validation_end(self, trainer: pl.Trainer, pl_module: Any) -> None:
        if not trainer.is_global_zero or trainer.sanity_checking or self.count < 1:
            return
        from PIL import Image, PngImagePlugin

        loader: Any = trainer.val_dataloaders
        batch = next(iter(loader))
        picture = self.draw(pl_module, batch)
        text = PngImagePlugin.PngInfo()
        text.add_text("pairs", str(min(self.count, len(batch["flow"]))))
        with atomic_path(self.folder / f"step-{pl_module.steps_done:07d}.png") as temporary:
            Image.fromarray(picture).save(temporary, pnginfo=text)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("val/pairs", picture, pl_module.steps_done, dataformats="HWC")

    @torch.no_grad()
    def draw(self, module: Any, batch: dict[str, Any]) -> np.ndarray[Any, Any]:
        """One row per pair, its columns as PICTURE_COLUMNS says; uint8 [H', W', 3]."""
        first = {name: batch[name][: self.count].to(module.device) for name in ("frame1", "frame2", "flow")}
        known = batch["valid"][: self.count, 0].cpu().numpy() if "valid" in batch else itertools.repeat(True)
        output = module(first["frame1"], first["frame2"]).float()
        expected = module.loss.expected_error(output[:, 2:]) * module.flow_scale
        arrays = (first["frame1"], first["frame2"], first["flow"], output[:, :2] * module.flow_scale, expected)
        rows = []
        maps = (a.permute(0, 2, 3, 1).cpu().numpy() for a in arrays)
        for one, two, truth, flow, sigma, valid in zip(*maps, known, strict=False):
            scale = viz.robust_scale(np.linalg.norm(truth, axis=2))
            error = np.linalg.norm(flow - truth, axis=2) * valid
            top = viz.robust_scale(error)
            rows.append(
                np.hstack(
                    [
                        one, two, viz.flow_to_image(truth, scale), viz.flow_to_image(flow, scale),
                        viz.uncertainty_to_image(np.linalg.norm(sigma, axis=2), 0.0, top),
                        viz.uncertainty_to_image(error, 0.0, top),
                    ]
                )
            )  # fmt: skip
        return np.vstack(rows)


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
