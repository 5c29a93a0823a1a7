# SPDX-License-Identifier: MIT
"""How a network is trained: one optimisation step, the averaged weights, and the validation scores."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from ajna.metrics import end_point_error
from ajna.model import checkpoint_path
from ajna.nn import load_checkpoint, network_input
from ajna.training.failure import NonFiniteLoss, save_batch
from ajna.training.guidance import FlowHeads, averaged, start_with_motion_energy
from ajna.training.options import GuidanceOptions, LossOptions, NetOptions, OptimOptions
from ajna.training.scores import ValidationScores


class FlowModule(pl.LightningModule):
    """FlowNet with the uncertainty loss, trained step by step (epochs are the data module's affair).

    Two networks are kept: ``net`` is optimised, ``ema`` is the running average of its weights, which is validated and
    shipped. Everything that depends on time (learning rate, hand-over from L1, averaging) is a function of
    ``steps_done``, so that a resumed run continues as if it had not stopped.

    Args:
        net: shape of the network.
        loss: the uncertainty loss and the hand-over to it.
        optim: optimizer, learning rate, clipping, averaging.
        guidance: aids for the start.
        flow_scale: the network predicts flow in pixels divided by this.
        init_from: a checkpoint (.safetensors), or the name of a shipped model, whose weights to begin with; its shape
            must be that of ``net``.
        grow: ``net`` may have parts that ``init_from`` lacks (skip connections, heads at three scales, a correlation
            volume). What new layers add to the old ones begins at zero: the network first answers as the old one.
        channels_last: keep weights and activations channels-last (faster on CPUs and tensor cores).
    """

    def __init__(
        self,
        net: NetOptions | None = None,
        loss: LossOptions | None = None,
        optim: OptimOptions | None = None,
        guidance: GuidanceOptions | None = None,
        flow_scale: float = 1.0,
        init_from: str | None = None,
        channels_last: bool = True,
        grow: bool = False,
    ) -> None:
        super().__init__()
        if not (math.isfinite(flow_scale) and flow_scale > 0):
            raise ValueError(f"training option flow_scale = {flow_scale}: give a number above 0")
        # Clipping, the guard against non-finite steps and the averaging must happen in one place and order.
        self.automatic_optimization = False
        self.options = loss or LossOptions()
        self.optim = optim or OptimOptions()
        self.guidance = guidance or GuidanceOptions()
        self.flow_scale = flow_scale
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        self.net = (net or NetOptions()).build()
        if init_from is not None:
            self._start_from(init_from, grow)
        elif self.guidance.motion_energy:
            start_with_motion_energy(self.net)
        self.heads = FlowHeads(self.net) if self.guidance.heads_weight else None
        self.net.to(memory_format=self.memory_format)  # type: ignore[call-overload]
        self.ema = (net or NetOptions()).build()
        self.ema.to(memory_format=self.memory_format)  # type: ignore[call-overload]
        self.ema.load_state_dict(self.net.state_dict())
        self.ema.requires_grad_(False).eval()
        self.loss = self.options.build()
        self.steps_done = 0  # batches taken from the stream, skipped ones included
        self.samples_done = 0
        self.skipped = 0
        self.seconds = 0.0  # spent in training over all resumes
        self._bad_in_a_row = 0
        self.failure_folder: Path | None = None  # where the batch goes at which the run ended
        self._scores: ValidationScores | None = None
        self._clock: float | None = None

    def _start_from(self, path: str, grow: bool) -> None:
        loaded, metadata = load_checkpoint(checkpoint_path(path))
        if metadata["flow_scale"] != self.flow_scale:
            raise ValueError(
                f"checkpoint '{path}' has flow_scale {metadata['flow_scale']}, not {self.flow_scale}: give that one"
            )
        theirs, mine = loaded.state_dict(), self.net.state_dict()
        grown = grow and all(name in mine and mine[name].shape == tensor.shape for name, tensor in theirs.items())
        if loaded.config != self.net.config and not grown:
            raise ValueError(
                f"checkpoint '{path}' holds {loaded!r}, not {self.net!r}: give net options that agree"
                + (" but for new parts" if grow else ", or 'grow: true' where the net only has more parts")
            )
        new = [name for name in mine if name not in theirs]
        # Heads, skips, and the last layer of the matching part are what is added to the old layers.
        last = max((name.split(".")[1] for name in new if name.startswith("matching.")), default="")
        for name in new:
            if name.startswith(("heads.", "skips.", f"matching.{last}.")):
                theirs[name] = torch.zeros_like(mine[name])
        self.net.load_state_dict({**mine, **theirs})

    # --- one step ------------------------------------------------------------------------------------------------

    def configure_optimizers(self) -> torch.optim.Optimizer:
        options = self.optim
        # Weight decay is for convolution kernels only; biases and normalisation have one dimension.
        trained = [*self.net.parameters(), *(self.heads.parameters() if self.heads is not None else ())]
        groups = [
            {"params": [p for p in trained if p.dim() > 1], "weight_decay": options.weight_decay},
            {"params": [p for p in trained if p.dim() <= 1], "weight_decay": 0.0},
        ]
        kind = {"adamw": torch.optim.AdamW, "adam": torch.optim.Adam}[options.optimizer]
        return kind(groups, lr=options.lr, betas=tuple(options.betas))

    def forward(self, frame1: Tensor, frame2: Tensor) -> Tensor:
        """uint8 [N, 3, H, W] RGB twice -> [N, 4, H, W] of the averaged network."""
        return self.ema(self._input(frame1, frame2))

    def _input(self, frame1: Tensor, frame2: Tensor) -> Tensor:
        return network_input(frame1, frame2).contiguous(memory_format=self.memory_format)

    def objective(self, output: Tensor, batch: dict[str, Any], step: int) -> Tensor:
        """The scalar to minimise at ``step`` for one scale: see LossOptions. ``output`` [N, 4, H, W], float32."""
        flow, raw = output[:, :2], output[:, 2:]
        target, valid = batch["flow"] / self.flow_scale, batch.get("valid")
        weight = None
        if self.options.occluded_weight != 1.0:
            if "occlusion" not in batch:
                raise ValueError(
                    f"training option loss.occluded_weight = {self.options.occluded_weight}: the data has no occlusion "
                    "masks, give 1"
                )
            weight = torch.where(batch["occlusion"], self.options.occluded_weight, 1.0)
        share = self.options.flow_share(step)
        led, raw = _scale_gradient(flow, share), _scale_gradient(raw, self.options.raw_share(step))
        loss = self.loss(led, raw, target, valid, weight)
        if share < 1.0:
            error = (flow - target).abs()
            if valid is not None:
                error, weight = torch.where(valid, error, 0.0), valid * (1.0 if weight is None else weight)
            l1 = error.mean() if weight is None else (error * weight).sum() / (2 * weight.sum()).clamp_min(1.0)
            loss = loss + (1.0 - share) * l1
        return loss

    def forward_loss(self, batch: dict[str, Any], step: int) -> tuple[Tensor, Tensor]:
        """The optimised network's output [N, 4, H, W], float32, and the scalar to minimise at ``step``, heads included.

        Raises:
            ValueError: with heads or scales, frames whose sides are no multiples of the network's stride.
        """
        frames = self._input(batch["frame1"], batch["frame2"])
        several = bool(self.net.config.scale_heads)
        if self.heads is None and not several:
            output = self.net(frames).float()
            return output, self.objective(output, batch, step)
        stride = self.net.config.stride
        if frames.shape[2] % stride or frames.shape[3] % stride:
            remedy = "" if several else ", or guidance.heads_weight 0"
            raise ValueError(
                f"training crops of {frames.shape[3]}x{frames.shape[2]}: give sizes whose sides are multiples of "
                f"{stride}{remedy}"
            )
        scales, layers = self.net.forward_scales_and_layers(frames)
        *coarser, output = (scale.float() for scale in scales)
        loss = self.objective(output, batch, step)
        weight = 1.0
        for scale in reversed(coarser):
            weight *= self.options.coarser_weight
            loss = loss + weight * self.objective(scale, _coarse(batch, scale.shape[-2:]), step)
        if self.heads is not None:
            aid = self.heads.loss(layers, batch["flow"] / self.flow_scale, batch.get("valid"))
            loss = loss + self.guidance.weight_at(step) * aid
        return output, loss

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        step, optimizer = self.steps_done, self.optimizers()
        assert isinstance(optimizer, pl.core.optimizer.LightningOptimizer)
        rate = self.optim.lr_at(step, self.trainer.max_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate
        statistics = list(self.net.buffers())
        before = [buffer.clone() for buffer in statistics]
        output, loss = self.forward_loss(batch, step)
        optimizer.zero_grad()
        self.manual_backward(loss)
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.optim.gradient_clip or math.inf)
        if self._usable(loss.detach(), norm, batch):
            optimizer.step()
            self._average()
        else:  # or one overflow in an activation would stay in the running statistics for good
            for buffer, value in zip(statistics, before, strict=True):
                buffer.copy_(value)
        self.steps_done += 1
        # Lightning counts the steps that were applied; a skipped one has had its turn, too.
        self.trainer.should_stop |= 0 < self.trainer.max_steps <= self.steps_done
        self.samples_done += batch["flow"].shape[0] * self.trainer.world_size
        if step % max(self.trainer.log_every_n_steps, 1) == 0:  # type: ignore[attr-defined]
            with torch.no_grad():
                valid = batch["valid"][:, 0] if "valid" in batch else slice(None)
                error = end_point_error(output[:, :2] * self.flow_scale, batch["flow"])[valid].mean()
                still = torch.linalg.vector_norm(batch["flow"], dim=1)[valid].mean()
            scores = {"loss": loss.item(), "epe": error.item(), "lr": rate, "gradient_norm": norm.item()}
            scores |= {"zero_epe": still.item(), "skipped": float(self.skipped)}
            self.log_dict({f"train/{name}": value for name, value in scores.items()} | self._epoch())

    def _epoch(self) -> dict[str, float]:
        """How often the data set has been gone through, in place of Lightning's own count, which is always 0."""
        steps = getattr(getattr(self.trainer, "datamodule", None), "steps_per_epoch", None)
        return {"epoch": self.steps_done / steps} if steps else {}

    def _usable(self, loss: Tensor, norm: Tensor, batch: dict[str, Any]) -> bool:
        """Whether this step's update may be applied; the same answer on all ranks.

        Raises:
            NonFiniteLoss: it was not for ``optim.max_bad_steps`` steps in a row; the last batch is then in a file.
        """
        fine = bool(torch.isfinite(loss) & torch.isfinite(norm))
        if self.trainer.world_size > 1:  # gradients are shared, losses are not
            fine = self.trainer.strategy.reduce_boolean_decision(fine, all=True)
        if fine:
            self._bad_in_a_row = 0
            return True
        self.skipped += 1
        self._bad_in_a_row += 1
        if self._bad_in_a_row >= self.optim.max_bad_steps:
            rank = f"-rank-{self.global_rank}" if self.trainer.world_size > 1 else ""
            path = (self.failure_folder or Path()) / f"bad-batch-step-{self.steps_done:07d}{rank}.npz"
            save_batch(path, batch, loss=loss.item(), gradient_norm=norm.item())
            raise NonFiniteLoss(
                f"loss or gradient was not finite for {self._bad_in_a_row} steps in a row (step {self.steps_done}, its "
                f"batch is in '{path}'): resume from the last checkpoint with a lower optim.lr"
            )
        return False

    @torch.no_grad()
    def _average(self) -> None:
        # Early on the average follows quickly, or the random start would linger in it.
        decay = min(self.optim.ema_decay, (1 + self.steps_done) / (10 + self.steps_done))
        theirs = [t for t in (*self.net.parameters(), *self.net.buffers()) if t.is_floating_point()]
        mine = [t for t in (*self.ema.parameters(), *self.ema.buffers()) if t.is_floating_point()]
        torch._foreach_lerp_(mine, theirs, 1.0 - decay)
        for average, current in zip(self.ema.buffers(), self.net.buffers(), strict=True):
            if not average.is_floating_point():
                average.copy_(current)

    def train(self, mode: bool = True) -> FlowModule:
        super().train(mode)
        self.ema.eval()  # never in training mode: its statistics are averages, too
        return self

    # --- validation ----------------------------------------------------------------------------------------------

    def on_validation_epoch_start(self) -> None:
        self._scores = ValidationScores(self.device)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        assert self._scores is not None
        output, valid = self(batch["frame1"], batch["frame2"]).float(), batch.get("valid")
        raw = output[:, 2:]
        loss = self.loss(output[:, :2], raw, batch["flow"] / self.flow_scale, valid)
        self._scores.update(
            output[:, :2] * self.flow_scale,
            batch,
            self.loss.uncertainty(raw),
            self.loss.expected_error(raw) * self.flow_scale,
            loss,
        )

    def on_validation_epoch_end(self) -> None:
        assert self._scores is not None
        values = self._scores.compute()
        self.log_dict({f"val/{name}": value for name, value in values.items()} | self._epoch())

    # --- accounting ----------------------------------------------------------------------------------------------

    def on_train_start(self) -> None:
        # Resumed at its end, a run is over although steps were skipped.
        self.trainer.should_stop |= 0 < self.trainer.max_steps <= self.steps_done

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self._clock is None:
            self._clock = time.monotonic()

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        now = time.monotonic()
        self.seconds += now - (self._clock or now)
        self._clock = now

    def on_validation_end(self) -> None:
        self._clock = None  # validation is not training time

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        names = ("steps_done", "samples_done", "skipped", "seconds")
        checkpoint["ajna"] = {name: getattr(self, name) for name in names}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        for name, value in checkpoint["ajna"].items():
            setattr(self, name, value)

    def provenance(self) -> dict[str, str]:
        """How the weights came about, for the checkpoint's metadata."""
        return {
            "steps": str(self.steps_done),
            "samples": str(self.samples_done),
            "training_seconds": f"{self.seconds:.0f}",
            "skipped_steps": str(self.skipped),
            "torch": torch.__version__,
        }


def _coarse(batch: dict[str, Any], size: Sequence[int]) -> dict[str, Any]:
    """The ground truth of ``batch`` at (h, w): flow averaged over its valid pixels, still in pixels of the full size; a
    cell is valid, or occluded, where half of it is."""
    mean, share = averaged(batch["flow"], batch.get("valid"), size)
    coarse: dict[str, Any] = {"flow": mean}
    if share is not None:
        coarse["valid"] = share >= 0.5
    if "occlusion" in batch:
        coarse["occlusion"] = averaged(batch["occlusion"].float(), None, size)[0] >= 0.5
    return coarse


def _scale_gradient(x: Tensor, factor: float) -> Tensor:
    """``x`` in value, with ``factor`` times its gradient."""
    if factor == 1.0:
        return x
    return x.detach() + factor * (x - x.detach()) if factor else x.detach()
