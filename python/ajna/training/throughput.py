# SPDX-License-Identifier: MIT
"""Where the time goes: samples per second of the data alone, of the step alone, and of both together."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch

from ajna.training.data import SyntheticData
from ajna.training.datasets import DatasetData
from ajna.training.module import FlowModule


def throughput(
    module: FlowModule,
    data: SyntheticData | DatasetData,
    precision: str = "32-true",
    repeats: int = 10,
    warmup: int = 2,
) -> list[dict[str, Any]]:
    """Measure every stage of the curriculum; a data set has one.

    Returns:
        Per stage: ``stage`` (text), and samples per second: ``samples`` (scenes made, pairs read), ``step``, ``both``.
    """
    device = module.device
    if precision not in ("32-true", "bf16-mixed"):
        raise ValueError(f"precision '{precision}' cannot be measured here: give 32-true or bf16-mixed")
    if repeats < 1:
        raise ValueError(f"training option repeats = {repeats}: give at least 1")
    module.train()
    optimizer = module.configure_optimizers()

    def step(batch: dict[str, Any]) -> None:
        mixed = torch.autocast(device.type, torch.bfloat16) if precision == "bf16-mixed" else nullcontext()
        with mixed:
            _, loss = module.forward_loss(batch, 0)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.net.parameters(), module.optim.gradient_clip or math.inf)
        optimizer.step()
        module._average()

    def rate(action: Callable[[], object], batch: int) -> float:
        for _ in range(warmup):
            action()
        _synchronize(device)
        begin = time.perf_counter()
        for _ in range(repeats):
            action()
        _synchronize(device)
        return batch * repeats / (time.perf_counter() - begin)

    results = []
    for text, batch, start in data.measured():
        alone = iter(data.stream(start, device=device, prefetch=0))
        fixed = next(alone)
        samples = rate(partial(next, alone), batch)
        steps = rate(partial(step, fixed), batch)
        stream = iter(data.stream(start, device=device))
        both = rate(lambda source=stream: step(next(source)), batch)  # type: ignore[misc]
        stream.close()
        results.append({"stage": text, "samples": samples, "step": steps, "both": both})
    return results


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
