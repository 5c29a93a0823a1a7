# SPDX-License-Identifier: MIT
"""Seeds that follow from a run's seed and a position, never from a counter that a restart would reset."""

from __future__ import annotations

from ajna.data.seeds import derive_seed

_VALIDATION_BIT = 1 << 62


def training_seed(run_seed: int, stage: int, number: int, rank: int) -> int:
    """Seed of the ``number``-th generated batch of a stage on one rank; below 2**62."""
    return derive_seed("training", run_seed, stage, number, rank)


def validation_seed(number: int) -> int:
    """Seed of the ``number``-th validation batch: the same in all runs, and never a training seed (2**62 or above)."""
    return _VALIDATION_BIT | derive_seed("validation", number)
