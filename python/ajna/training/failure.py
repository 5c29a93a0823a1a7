# SPDX-License-Identifier: MIT
"""The end of a run that no longer learns, with the batch at which it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ajna.training.run_files import atomic_path


class NonFiniteLoss(RuntimeError):
    """Loss or gradient was not finite for too many steps in a row."""


def save_batch(path: Path, batch: dict[str, Any], **figures: float) -> None:
    """Write a training batch to ``path`` (.npz), with ``figures`` beside it: read it with ``numpy.load``."""
    content: dict[str, Any] = {**batch, **figures}
    arrays: dict[str, Any] = {
        name: value.cpu().numpy() if isinstance(value, Tensor) else value for name, value in content.items()
    }
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)
