# SPDX-License-Identifier: MIT
"""``ajna info``: what is installed here."""

from __future__ import annotations

import json
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import typer

from ajna.cli.options import JsonOption

_PIPED_WIDTH = 400  # columns, where there is no terminal to wrap for


def info(as_json: JsonOption = False) -> None:
    """Versions, build, devices, threads and the shipped models with their cards.

    Example: ajna info --json
    """
    record = {"versions": _versions(), "build": _build(), "devices": _devices(), "models": _models()}
    if as_json:
        typer.echo(json.dumps(record, indent=2))
    else:
        _print(record)


def _versions() -> dict[str, str | None]:
    import torch

    from ajna import _core

    def installed(name: str) -> str | None:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            return None

    return {
        "ajna": _core.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": installed("numpy"),
        "lightning": installed("lightning"),
    }


def _build() -> dict[str, Any]:
    from ajna import _core

    return {
        "extension": str(Path(_core.__file__).resolve()),
        "torch_version": _core.build_torch_version,
        "vision": _core.with_vision,
    }


def _devices() -> dict[str, Any]:
    import os

    import torch

    cuda = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return {
        "cpu": {
            "machine": platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
            "threads": torch.get_num_threads(),
            "capability": torch.backends.cpu.get_cpu_capability(),
        },
        "cuda": cuda,
    }


def _models() -> list[dict[str, Any]]:
    import ajna
    from ajna import nn

    models = []
    for name, path in ajna.models().items():
        net, card = nn.load_checkpoint(path)
        models.append(
            {
                "name": name,
                "path": str(path),
                "bytes": path.stat().st_size,
                "parameters": nn.count_parameters(net),
                "loss": card["loss"],
                "flow_scale": card["flow_scale"],
                "provenance": card["provenance"],
                "calibration": None if card["calibration"] is None else card["calibration"].provenance,
            }
        )
    return models


def _print(record: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    cpu, cuda = record["devices"]["cpu"], record["devices"]["cuda"]
    table = Table.grid(padding=(0, 2))
    table.add_row("versions", ", ".join(f"{name} {version}" for name, version in record["versions"].items() if version))
    build = record["build"]
    table.add_row("build", f"for torch {build['torch_version']}, {'with' if build['vision'] else 'without'} vision")
    table.add_row("extension", build["extension"])
    table.add_row(
        "cpu", f"{cpu['machine']} {cpu['capability']}, {cpu['cores']} cores usable, {cpu['threads']} torch threads"
    )
    table.add_row("cuda", ", ".join(cuda) or "none")
    for model in record["models"]:
        table.add_row(
            f"model {model['name']}",
            f"{model['parameters']:,} parameters, {model['bytes'] / 1e6:.1f} MB, loss {model['loss']}",
        )
        for key, value in model["provenance"].items():
            table.add_row("", f"{key}: {value}")
        calibration = model["calibration"]
        calibrated = "no" if calibration is None else ", ".join(f"{key} {value}" for key, value in calibration.items())
        table.add_row("", f"calibrated: {calibrated}")
    if not record["models"]:
        table.add_row("models", "none shipped with this build")
    screen = Console(highlight=False, markup=False)
    if not screen.is_terminal:
        screen.width = _PIPED_WIDTH
    screen.print(table)
