# SPDX-License-Identifier: MIT
"""Metadata plugin for scikit-build-core: a wheel of ours needs the torch minor version that it was compiled against.

LibTorch's C++ ABI changes with every minor version, so the requirement is read from the torch that the build uses,
not written down. A source distribution, which is tied to none, asks for the oldest supported torch.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from typing import Any

OLDEST_TORCH = "2.6"


class TorchRequirement:
    """Adds one entry to `project.dependencies`."""

    def __init__(self) -> None:
        self._for_sdist = False

    def build_state(self, state: str) -> None:
        self._for_sdist = state == "sdist"

    def dynamic_metadata(self, settings: Mapping[str, Any], project: Mapping[str, Any]) -> dict[str, list[str]]:
        if self._for_sdist:
            return {"dependencies": [f"torch>={OLDEST_TORCH}"]}
        try:
            version = importlib.metadata.version("torch")
        except importlib.metadata.PackageNotFoundError:
            raise RuntimeError(
                "ajna compiles against the installed torch, and there is none: "
                "`pip install torch`, then `pip install --no-build-isolation .`"
            ) from None
        major, minor = version.split(".")[:2]
        return {"dependencies": [f"torch=={major}.{minor}.*"]}

    def dynamic_wheel(self, settings: Mapping[str, Any]) -> dict[str, bool]:
        return {"dependencies": True}
