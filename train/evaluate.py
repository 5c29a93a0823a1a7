#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""`ajna evaluate` as a script: python train/evaluate.py --root DIR [--model NAME|FILE] [--method dis] ..."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run `ajna evaluate` with these arguments (default: those of the process); returns the exit code."""
    from ajna.cli import main as ajna_main

    return ajna_main(["evaluate", *(sys.argv[1:] if argv is None else argv)])


if __name__ == "__main__":
    sys.exit(main())
