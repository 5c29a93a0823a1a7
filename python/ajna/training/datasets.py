# SPDX-License-Identifier: MIT
"""Published data sets and packs of them as a Lightning data module."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch

from ajna import _core, synth
from ajna.data.dataset import FlowDataset
from ajna.data.packed import PackedDataset
from ajna.data.registry import DATASETS, open_dataset
from ajna.training.epochs import EpochStream, PairReader, ValidationBatches, steps_per_epoch
from ajna.training.windows import FITS


class DatasetData(pl.LightningDataModule):
    """Frame pairs of a data set, or of a pack of one, epoch after epoch.

    Args:
        dataset: kind of the training pairs: chairs2, things3d, packed, ... (``ajna.data.registry.DATASETS``).
        root: its folder.
        val_root, val_dataset: the same for the validation pairs; by default those of training, with the part of the
            data set that is meant for scoring.
        options: of the data set, e.g. {pass_name: final}; also of the validation pairs where ``val_dataset`` is not
            given.
        val_options: of the validation pairs, over ``options``.
        size: (width, height) of the network's input.
        fit: how frames are scaled before ``size`` is cut from them: ``cover`` by one factor until they just cover it,
            ``resize`` to it along each axis, ``native`` not at all. The cut is random in training, else central.
        batch: pairs of a step, over all processes.
        augment: options of ``ajna.synth.Augmenter``, which then cuts; empty for none.
        seed: of order, cuts and augmentation. Equal seeds give equal samples, also over a resume.
        workers: threads that decode files; by default one per CPU, at most 8. Samples do not depend on it.
        prefetch: batches held ready by a background thread; 0 reads between the steps.
        resident: hold the whole training pack in the memory of the training device.
        skip_bad: count and list bad samples, and take the next good one instead, where the default is to stop.
        val_pairs: score only the first so many pairs; by default all.
        val_batch: pairs of a validation batch.

    Raises:
        ValueError, FileNotFoundError: unusable options, a folder that lacks something, validation pairs that are
            training pairs, too.
    """

    source = "read"

    def __init__(
        self,
        dataset: str,
        root: str | None = None,
        val_root: str | None = None,
        val_dataset: str | None = None,
        options: dict[str, Any] | None = None,
        val_options: dict[str, Any] | None = None,
        size: tuple[int, int] = (320, 240),
        fit: str = "cover",
        batch: int = 32,
        augment: dict[str, Any] | None = None,
        seed: int = 1,
        workers: int | None = None,
        prefetch: int = 2,
        resident: bool = False,
        skip_bad: bool = False,
        val_pairs: int | None = None,
        val_batch: int = 8,
    ) -> None:
        super().__init__()
        for name, value, least in (
            ("size", min(size), 1),
            ("batch", batch, 1),
            ("prefetch", prefetch, 0),
            ("workers", workers, 1),
            ("val_pairs", val_pairs, 1),
            ("val_batch", val_batch, 1),
        ):
            if value is not None and value < least:
                raise ValueError(f"training option data.{name} = {value}: give at least {least}")
        if fit not in FITS:
            near = _core.nearest_name(fit, list(FITS))
            raise ValueError(f"training option data.fit = {fit}: {_hint(near)}give {', '.join(FITS)}")
        if root is None:
            raise ValueError(f"training option data.root is missing: give the folder of data set '{dataset}'")
        if val_root is None and "packed" in (dataset, val_dataset):
            raise ValueError("training option data.val_root is missing: give the pack of the validation pairs")
        self.dataset, self.size, self.fit, self.batch = dataset, (size[0], size[1]), fit, batch
        self.augment, self.seed, self.prefetch, self.resident = dict(augment or {}), seed, prefetch, resident
        self.val_pairs, self.val_batch = val_pairs, val_batch
        augmenter = _augmenter(self.augment)
        training = open_dataset(dataset, root, skip_bad=skip_bad, options=_text(options or {}))
        inherited = {} if val_dataset else {k: v for k, v in (options or {}).items() if k not in _scored(dataset)}
        validation = open_dataset(
            val_dataset or dataset,
            val_root or root,
            skip_bad=skip_bad,
            options=_text({**inherited, **(val_options or {})}),
            scoring=True,
        )
        _check_apart(training, validation)
        window = (self.size[1], self.size[0])
        self.train_reader = PairReader(training, window, fit, augmenter, workers)
        self.val_reader = PairReader(validation, window, fit, None, workers)
        self.steps_per_epoch = steps_per_epoch(len(training), batch)
        if resident and not isinstance(training, PackedDataset):
            self.train_reader.reside("cpu")  # refuses

    @property
    def bad(self) -> dict[str, str]:
        """Case -> why it was skipped, of the bad samples met so far (with ``skip_bad``)."""
        return {**self.val_reader.dataset.bad, **self.train_reader.dataset.bad}

    def stream(
        self,
        start: int = 0,
        rank: int = 0,
        device: torch.device | str = "cpu",
        prefetch: int | None = None,
        world: int = 1,
    ) -> EpochStream:
        """Training batches from step ``start`` on."""
        ahead = self.prefetch if prefetch is None else prefetch
        if self.resident:
            self.train_reader.reside(device)
        return EpochStream(self.train_reader, self.batch, self.seed, rank, world, start, device, ahead)

    def measured(self) -> list[tuple[str, int, int]]:
        """(description, batch, first step), for ``throughput``."""
        kept = " resident" if self.resident else ""
        return [(f"{self.size[1]}x{self.size[0]} batch {self.batch} from {self.dataset}{kept}", self.batch, 0)]

    def describe(self) -> str:
        """One line for a model card: where the samples came from."""
        data = self.train_reader.dataset
        source = data.info["source"].get("dataset", "a data set") if isinstance(data, PackedDataset) else self.dataset
        kind = DATASETS[source].load().title if source in DATASETS else source
        text = f"{kind}, {len(data)} pairs in batches of {self.batch}, {self.size[0]}x{self.size[1]} ({self.fit})"
        options = " ".join(f"{name}={value}" for name, value in self.augment.items())
        return f"{text}, seed {self.seed}" + (f", augmented: {options}" if options else "")

    def total_steps(self, max_epochs: int | None, max_steps: int) -> int:
        """The steps of a run that is limited by epochs, steps, or both; raises ValueError if it is by neither."""
        limits = [self.steps_per_epoch * max_epochs] if max_epochs is not None and max_epochs > 0 else []
        limits += [max_steps] if max_steps > 0 else []
        if not limits:
            raise ValueError(f"training option trainer.max_epochs = {max_epochs}: give the epochs to train")
        return min(limits)

    # Lightning hooks.

    def setup(self, stage: str) -> None:
        """Count in steps: to Lightning, a run is one endless epoch, for only then does it resume anywhere exactly."""
        trainer = self.trainer
        if stage != "fit" or trainer is None:
            return
        trainer.fit_loop.epoch_loop.max_steps = self.total_steps(trainer.max_epochs, trainer.max_steps)
        trainer.fit_loop.max_epochs = -1
        if trainer.check_val_every_n_epoch is not None or isinstance(trainer.val_check_interval, float):
            share = trainer.val_check_interval if isinstance(trainer.val_check_interval, float) else 1.0
            epochs = trainer.check_val_every_n_epoch or 1
            trainer.val_check_interval = max(1, math.floor(self.steps_per_epoch * share * epochs))
            trainer.check_val_every_n_epoch = None

    def train_dataloader(self) -> EpochStream:
        trainer = self.trainer
        assert trainer is not None
        module: Any = trainer.lightning_module
        rank, world = trainer.global_rank, trainer.world_size
        return self.stream(module.steps_done, rank, trainer.strategy.root_device, world=world)

    def val_dataloader(self) -> ValidationBatches:
        trainer = self.trainer
        assert trainer is not None
        rank, world, device = trainer.global_rank, trainer.world_size, trainer.strategy.root_device
        return ValidationBatches(self.val_reader, self.val_batch, self.val_pairs, rank, world, device)

    def state_dict(self) -> dict[str, Any]:
        return {"pairs": len(self.train_reader.dataset), "batch": self.batch, "seed": self.seed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        for name, value in self.state_dict().items():
            if state_dict.get(name) != value:
                raise ValueError(
                    f"the run was begun with {name} = {state_dict.get(name)} of the training data, not {value}: give "
                    "the same data to resume, or another --name with --model.init_from"
                )


def _hint(near: str) -> str:
    return f"did you mean '{near}'? " if near else ""


def _text(options: Mapping[str, Any]) -> dict[str, str]:
    """Options of a config as the data sets take them from command lines."""
    return {name: str(value) for name, value in options.items()}


def _scored(dataset: str) -> Mapping[str, str]:
    return DATASETS[dataset].scored if dataset in DATASETS else {}


def _augmenter(options: dict[str, Any]) -> Any:
    if not options:
        return None
    kind = getattr(synth, "Augmenter", None)
    if kind is None:
        raise ValueError("training option data.augment: this build has no augmentation (ajna.synth.Augmenter), give {}")
    return kind(options)


def _check_apart(training: FlowDataset, validation: FlowDataset) -> None:
    """Raise ValueError if a frame that is validated is trained on, too."""

    def source(dataset: FlowDataset, index: int) -> object:
        if isinstance(dataset, PackedDataset):
            return dataset.names[index], dataset.checksum(index)
        return dataset.files(index)[0]

    trained = {source(training, index) for index in range(len(training))}
    for index, name in enumerate(validation.names):
        if source(validation, index) in trained:
            raise ValueError(
                f"validation pair '{name}' is a training pair, too ('{validation.files(index)[0]}'): give another "
                "data.val_root or data.val_options"
            )
