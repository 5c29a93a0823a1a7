#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Pack a data set for training: python train/pack.py --dataset chairs2 --root DIR --out DIR (see docs/datasets.md)."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Pack with these arguments (default: those of the process); returns the exit code."""
    from ajna.data.pack_command import main as run

    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
