# SPDX-License-Identifier: MIT
"""Network inputs from which int8 takes the range of each layer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ajna.exports.runners import Array, network_input

RENDERED = 32  # scenes, where no frames are given
MAX_PAIRS = 128


def inputs_of_frames(source: Path, width: int, height: int, max_pairs: int = MAX_PAIRS) -> list[Array]:
    """Successive frames of a folder of images or of a video file, resized, as network inputs [1, 6, height, width].

    Of more than `max_pairs` pairs, as many are taken evenly over the whole.

    Raises:
        FileNotFoundError: no such folder or file.
        ValueError: fewer than two frames, or frames that cannot be read.
    """
    from ajna import io
    from ajna.data.pairs import resize_area

    images = [resize_area(frame.image, width, height) for frame in io.VideoSource(str(source))]
    if len(images) < 2:
        raise ValueError(f"calibration frames '{source}' hold {len(images)} frame: give at least two successive frames")
    firsts = np.unique(np.linspace(0, len(images) - 2, min(max_pairs, len(images) - 1)).round().astype(int))
    return _inputs((images[index], images[index + 1]) for index in firsts)


def inputs_of_scenes(width: int, height: int, count: int = RENDERED) -> list[Array]:
    """Rendered scenes as network inputs [1, 6, height, width]; no training run and no check has seen them."""
    from ajna.data.synthetic import SyntheticScenes

    scenes = SyntheticScenes(count, width, height, seed=77, scene={"bank_size": 2 * count})
    return _inputs((pair.frame1, pair.frame2) for pair in map(scenes.read, range(count)))


def _inputs(pairs: Iterable[tuple[Array, Array]]) -> list[Array]:
    return [network_input(first, second) for first, second in pairs]
