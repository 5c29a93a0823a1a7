#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Renew docs/videos: one small video (animated WebP) of a trial in each simulated world.

python tools/simulation_videos.py [WORLD ...] [--method depth] [--seed 0] [--out FOLDER]

The trials are those of `ajna sim WORLD --video`; what they leave lies in FOLDER (by default a temporary one). Left:
what the camera sees, with mask and point; right: the vehicle from outside. A trial that fails is not shown.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
from PIL import Image

from ajna.sim.trials import TrialPlan, run_trials, trial_path
from ajna.sim.worlds import WORLDS

ROOT = Path(__file__).resolve().parents[1]
VIDEOS = ROOT / "docs" / "videos"
SIZE = (440, 165)  # of both pictures side by side
LARGEST_BYTES = 380_000
# World -> (every n-th frame is shown, for so many milliseconds); the throw is slowed down to a third.
PACES = {"forest": (3, 100), "indoor-forest": (2, 67), "boxes": (3, 100), "gap": (3, 100), "dodge": (1, 100)}
STILL_MS = 700  # for each of the two views of a pile


def frames_of(path: Path, every: int) -> list[Image.Image]:
    """Every n-th frame of a video, small."""
    reader = cv2.VideoCapture(str(path))
    frames = []
    index = 0
    while True:
        there, bgr = reader.read()
        if not there:
            break
        if index % every == 0:
            small = cv2.resize(bgr, SIZE, interpolation=cv2.INTER_AREA)
            frames.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
        index += 1
    reader.release()
    if not frames:
        raise ValueError(f"'{path}' holds no frames")
    return frames


def write_small(frames: list[Image.Image], milliseconds: int, path: Path) -> int:
    """Write an animated WebP at the best quality that keeps it small; its size in bytes."""
    for quality in (70, 55, 40, 30, 20, 12, 6):
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, quality=quality,
                       method=5)  # fmt: skip
        if path.stat().st_size <= LARGEST_BYTES:
            return path.stat().st_size
    raise ValueError(f"'{path}' does not get below {LARGEST_BYTES} bytes: show fewer frames")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", choices=[*WORLDS, []], metavar="WORLD", help=", ".join(WORLDS))
    parser.add_argument("--method", default="depth")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(argv)
    VIDEOS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        for world in options.worlds or WORLDS:
            plan = TrialPlan(world, options.method, 1, options.seed, options.out or Path(temporary), video=True)
            result = run_trials(plan)[0]
            if not result.success:
                print(f"{world}, seed {options.seed}: {result.reason}; choose another --seed", file=sys.stderr)
                return 2
            every, milliseconds = PACES.get(world, (1, STILL_MS))
            frames = frames_of(trial_path(plan, options.seed).with_suffix(".mp4"), every)
            size = write_small(frames, milliseconds, VIDEOS / f"{world}.webp")
            print(f"{world}: {len(frames)} frames, {size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
