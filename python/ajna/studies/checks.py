# SPDX-License-Identifier: MIT
"""What studies of generated scenes refuse before they begin."""

from __future__ import annotations

__all__ = ["check_scenes"]


def check_scenes(study: str, scenes: int, seed: int, width: int, height: int, least_px: int = 16) -> None:
    """Raises ValueError for fewer than 2 scenes, a seed below 0, or sides below `least_px`."""
    if scenes < 2 or seed < 0:
        raise ValueError(f"{study} study of {scenes} scenes, seed {seed}: give at least 2 scenes, a seed of at least 0")
    if width < least_px or height < least_px:
        raise ValueError(f"{study} study at {width}x{height}: give at least {least_px}x{least_px} pixels")
