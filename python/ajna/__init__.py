# SPDX-License-Identifier: MIT
"""Ajna: optical flow and its per-pixel uncertainty in one pass.

    import ajna

    model = ajna.load()                       # the shipped model; or a path
    field = model("frame1.png", "frame2.png")  # or two uint8 RGB arrays [H, W, 3]
    field.flow, field.uncertainty, field.expected_error  # float32 [H, W, 2] each

Submodules load when they are first used: ``ajna.nn``, ``ajna.losses``, ``ajna.synth``, ``ajna.io``, ``ajna.viz``, ...
"""

from __future__ import annotations

import importlib
import re
from typing import Any

import torch  # first: the extension needs its libraries

_REBUILD = "build ajna again (pip install --no-build-isolation --force-reinstall --no-deps .) or install that torch"


def _minor(version: str) -> str:
    """'2.13.0+cpu' -> '2.13'."""
    return ".".join(re.findall(r"\d+", version)[:2])


def _load_extension() -> None:
    """Import the extension, or say in one sentence that it and the installed torch do not belong together."""
    try:
        core = importlib.import_module("ajna._core")
    except ImportError as error:
        # A missing library or symbol of torch's; anything else (OpenCV is not installed, ...) speaks for itself.
        if not re.search(r"lib(torch|c10)|undefined symbol: (_ZNK?(3c10|5torch|2at)|THP)", str(error)):
            raise
        raise ImportError(
            f"ajna's extension does not load with torch {torch.__version__}, because it was built against another one: "
            f"{_REBUILD} ({error})",
            name="ajna._core",
        ) from error
    # torch's C++ interface changes between minor versions: a mismatch that happens to load may still crash later.
    if _minor(torch.__version__) != _minor(core.build_torch_version):
        raise ImportError(
            f"ajna was built against torch {core.build_torch_version} but torch {torch.__version__} is installed: "
            f"{_REBUILD}",
            name="ajna._core",
        )


_load_extension()

from ajna._core import __version__  # noqa: E402  (only after the check)
from ajna.model import FlowField, Model, load, models  # noqa: E402

__all__ = ["FlowField", "Model", "__version__", "load", "models"]

_SUBMODULES = (
    "analysis",
    "baselines",
    "calibration",
    "cli",
    "data",
    "evaluation",
    "io",
    "losses",
    "metrics",
    "nn",
    "plots",
    "synth",
    "tasks",
    "training",
    "viz",
)


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return importlib.import_module(f"ajna.{name}")
    raise AttributeError(f"module 'ajna' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBMODULES])
