# SPDX-License-Identifier: MIT
"""Where the time goes: samples per second of the scenes alone, of the step alone, and of both together."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch

from ajna.training.data import SyntheticData
from ajna.training.module import FlowModule


def throughput(
    module: FlowModule, data: SyntheticData, precision: str = "32-true", repeats: int = 10, warmup: int = 2
) -> list[dict[str, Any]]:
    """Measure every stage of the curriculum.

    Returns:
        Per stage: ``stage`` (text), ``scenes``, ``step`` and ``both`` in samples per second.
    """
    device = module.device
    if precision not in ("32-true", "bf16-mixed"):
        raise ValueError(f"precision '{precision}' cannot be measured here: give 32-true or bf16-mixed")
    module.train()
    optimizer = module.configure_optimizers()

    def step(batch: dict[str, Any]) -> None:
        mixed = torch.autocast(device.type, torch.bfloat16) if precision == "bf16-mixed" else nullcontext()
        with mixed:
            output = module.net(module._input(batch["frame1"], batch["frame2"])).float()
        loss = module.objective(output, batch, 0)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.net.parameters(), module.optim.gradient_clip)
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
    for stage in data.stages:
        alone = iter(data.stream(stage.from_step, device=device, prefetch=0))
        fixed = next(alone)
        scenes = rate(partial(next, alone), stage.batch)
        steps = rate(partial(step, fixed), stage.batch)
        stream = iter(data.stream(stage.from_step, device=device))
        both = rate(lambda source=stream: step(next(source)), stage.batch)  # type: ignore[misc]
        stream.close()
        text = f"{stage.height}x{stage.width} batch {stage.batch} from step {stage.from_step} reuse {stage.reuse}"
        results.append({"stage": text, "scenes": scenes, "step": steps, "both": both})
    return results


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
