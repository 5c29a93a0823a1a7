# SPDX-License-Identifier: MIT
"""What starting the flight program (``ajna_flight``) takes: its file, a folder as its camera, and what it says."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["SpoolFolder", "find_program", "is_ready", "memory_folder"]

_KEPT = 4  # files: the program reads one while others are being written


def find_program(path: str | Path | None = None) -> Path:
    """``ajna_flight``: as given, by the variable AJNA_FLIGHT_PROGRAM, or on the PATH.

    Raises:
        FileNotFoundError: it is nowhere.
    """
    named = path or os.environ.get("AJNA_FLIGHT_PROGRAM") or shutil.which("ajna_flight")
    if named is None or not Path(named).is_file():
        where = f"'{named}'" if named else "on the PATH"
        raise FileNotFoundError(
            f"the flight program is not {where}: build it (docs/flight.md) and name it by AJNA_FLIGHT_PROGRAM"
        )
    return Path(named)


def is_ready(said: str) -> bool:
    """Whether nothing but the pilot's switch is missing, by what the program has written so far."""
    return said.rstrip().endswith("the pilot's switch is off")


def memory_folder() -> Path | None:
    """A folder in memory, if there is one: the program is to wait for frames, not for a disk."""
    folder = Path("/dev/shm")
    return folder if folder.is_dir() else None


class SpoolFolder:
    """The writing side of ``source.kind: spool``: each frame is written under a hidden name, then renamed.

    Args:
        folder: an existing one; a few files are kept in it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, index: int, image: NDArray[np.uint8]) -> None:
        """Frame number ``index``: RGB uint8 [H, W, 3]."""
        self.put_bytes(index, f"P6 {image.shape[1]} {image.shape[0]} 255\n".encode() + image.tobytes())

    def put_bytes(self, index: int, data: bytes) -> None:
        """The bytes of a PPM file, whole or not."""
        hidden = self.folder / ".frame"
        hidden.write_bytes(data)
        os.replace(hidden, self.folder / f"frame{index % _KEPT}.ppm")
