#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train a model: ``python train/train.py fit --config train/configs/synthetic.yaml`` (see train/README.md)."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run the training command and return its exit code."""
    try:
        from ajna.training.cli import main as run
    except ModuleNotFoundError as error:
        print(f"train.py: package '{error.name}' is missing: pip install 'ajna[train]'", file=sys.stderr)
        return 2
    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
