#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""A trained model in another format, compared with its network: python train/export.py runs/chairs2 --out model.pt

The model is a checkpoint (.safetensors) or a run folder, of which best.safetensors is taken, or model.safetensors where
no validation has been. Further options are those of `ajna export`, of which --format is TorchScript by default.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def model_of(path: Path) -> Path:
    """The checkpoint that a run folder or a file stands for; raises FileNotFoundError if there is none."""
    if path.is_dir():
        for name in ("best.safetensors", "model.safetensors"):
            if (path / name).is_file():
                return path / name
        raise FileNotFoundError(f"run folder '{path}' holds no best.safetensors or model.safetensors: train first")
    if not path.is_file():
        raise FileNotFoundError(f"model '{path}' does not exist: give a run folder or a .safetensors file")
    return path


def main(argv: Sequence[str] | None = None) -> int:
    """Export with these arguments (default: those of the process); returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="run folder or checkpoint")
    args, rest = parser.parse_known_args(argv)
    try:
        model = model_of(args.model)
    except FileNotFoundError as error:
        print(f"export.py: {error}", file=sys.stderr)
        return 2
    from ajna.cli import main as ajna_main

    return ajna_main(["export", "--model", str(model), *rest])


if __name__ == "__main__":
    sys.exit(main())
