# SPDX-License-Identifier: MIT
"""What a measured time depends on: the machine and the versions, to be printed beside it."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from ajna import _core


def cpu_model() -> str:
    """The processor's name as the system gives it."""
    try:
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        match = None
    return match[1].strip() if match else platform.processor() or platform.machine()


def cpu_flags() -> frozenset[str]:
    """Instruction sets of the processor as Linux names them, e.g. "avx2"; empty where the system does not say."""
    try:
        match = re.search(r"^(?:flags|Features)\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        match = None
    return frozenset(match[1].split()) if match else frozenset()


def describe_machine() -> dict[str, Any]:
    """Processor, cores that this process may use, torch's threads, GPUs, and how busy the machine is just now."""
    return {
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "cuda": [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())],
        "load_average": round(os.getloadavg()[0], 2),  # of the last minute; above 0 before the start: others work, too
    }


def describe_versions(more: Iterable[str] = ()) -> dict[str, str]:
    """Versions of what runs, and of the packages `more`; those that are not installed are left out."""
    versions = {"ajna": _core.__version__, "python": platform.python_version(), "torch": torch.__version__}
    for name in ("numpy", "opencv-python-headless", "opencv-python", *more):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
