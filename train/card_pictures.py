#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""The pictures of a model card: how a run went, and where its model is wrong and does not know it.

python train/card_pictures.py --model best --run runs/synthetic_tasks --out docs/images

writes curves_best.png (from the run's log; without --run there is none) and failures_best.png: of held-out scenes those
whose error most exceeds what the model expects of itself.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SEED = 11  # of the scenes that are searched for failures
PRESETS = ("general", "navigate", "gap", "pile")


def curves(run: Path) -> Any:
    """Learning curves over those of the uncertainty, RGB uint8 [H, W, 3].

    Raises:
        FileNotFoundError: the folder holds no log.
    """
    from ajna.training.curves import learning_curves, read_run, uncertainty_curves

    log = read_run(run)
    upper, lower = learning_curves(log), uncertainty_curves(log)
    width = max(upper.shape[1], lower.shape[1])
    padded = [
        np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in (upper, lower)
    ]  # fmt: skip
    return np.concatenate(padded)


def failures(model: Any, scenes: int, count: int, width: int = 960) -> Any:
    """The ``count`` scenes whose mean error exceeds the mean expected error most, one above another.

    Returns:
        RGB uint8 [H, W, 3].
    """
    from ajna import plots
    from ajna.data.synthetic import SyntheticScenes

    found = []
    for preset in PRESETS:
        data = SyntheticScenes(scenes, seed=SEED, scene={"preset": preset})
        for index in range(scenes):
            pair = data[index]
            field = model(pair.frame1, pair.frame2)
            excess = (
                np.linalg.norm(field.flow - pair.flow, axis=2)[pair.valid].mean() - field.expected_error_norm.mean()
            )
            found.append((float(excess), preset, index, pair, field))
    found.sort(key=lambda entry: -entry[0])
    panels = [
        plots.uncertainty_panel(pair, field, title=f"{preset}, scene {index}", width=width)
        for _, preset, index, pair, field in found[:count]
    ]
    return np.concatenate(panels)


def main(argv: Sequence[str] | None = None) -> int:
    """Draw and write; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="best", help="model by name or file (default: best)")
    parser.add_argument("--run", type=Path, help="run folder whose log is drawn")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--name", help="in the files' names; by default the model's")
    parser.add_argument("--scenes", type=int, default=16, help="scenes of each preset that are searched (default: 16)")
    parser.add_argument("--count", type=int, default=4, help="failures that are shown (default: 4)")
    args = parser.parse_args(argv)
    try:
        if not args.out.is_dir():
            raise FileNotFoundError(f"folder '{args.out}' does not exist: make it first")
        if args.scenes < 1 or args.count < 1:
            raise ValueError(f"--scenes {args.scenes}, --count {args.count}: give at least 1 each")
        import ajna

        model = ajna.load(args.model)
        name = args.name or Path(args.model).stem
        pictures = {} if args.run is None else {f"curves_{name}.png": curves(args.run)}
        pictures[f"failures_{name}.png"] = failures(model, args.scenes, args.count)
        for file, picture in pictures.items():
            _write(args.out / file, picture)
    except (ValueError, OSError) as error:
        print(f"card_pictures.py: {error}", file=sys.stderr)
        return 2
    return 0


def _write(path: Path, picture: Any) -> None:
    """A PNG that is there completely or not at all."""
    from PIL import Image

    temporary = path.with_name(f".{path.name}.tmp")
    Image.fromarray(picture).save(temporary, format="PNG", optimize=True)
    os.replace(temporary, path)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
