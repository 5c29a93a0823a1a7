# SPDX-License-Identifier: MIT
"""From frame pairs of any size to training windows of one: scaling and cropping of batches, on their own device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ajna.data.frame_pair import FramePair, Truth, nearest_pixels, resampling_weights

FITS = ("cover", "resize", "native")

Tensors = dict[str, Tensor]


def pair_tensors(pair: FramePair) -> Tensors:
    """A pair as a batch of one, in the layout of ``PackedDataset.batch``.

    Returns:
        frame1, frame2: uint8 [1, 3, H, W]; flow: float32 [1, 2, H, W]; valid and what else there is: bool [1, 1, H, W];
        the other direction's with the prefix ``backward_``.

    Raises:
        ValueError: the pair has no ground truth.
    """
    if pair.truth is None:
        raise ValueError(f"case '{pair.name}' has no ground truth: nothing to learn from")
    batch = {name: _image(getattr(pair, name)) for name in ("frame1", "frame2")}
    batch |= _truth_tensors("", pair.truth)
    if pair.backward is not None:
        batch |= _truth_tensors("backward_", pair.backward)
    return batch


def _image(array: object) -> Tensor:
    return torch.as_tensor(array).permute(2, 0, 1)[None]


def _truth_tensors(prefix: str, truth: Truth) -> Tensors:
    found = {f"{prefix}flow": _image(truth.flow), f"{prefix}valid": torch.as_tensor(truth.valid)[None, None]}
    for name in ("occlusion", "motion_boundary"):
        if (mask := getattr(truth, name)) is not None:
            found[f"{prefix}{name}"] = torch.as_tensor(mask)[None, None]
    return found


def fitted_size(size: tuple[int, int], window: tuple[int, int], fit: str) -> tuple[int, int]:
    """(height, width) to which frames of ``size`` are scaled before a ``window`` is cut from them.

    ``cover``: by one factor, so that they just cover the window; ``resize``: to the window, along each axis by its own
    factor; ``native``: not at all.

    Raises:
        ValueError: native frames that are smaller than the window.
    """
    (height, width), (wanted_height, wanted_width) = size, window
    if fit == "resize":
        return window
    if fit == "native":
        if height < wanted_height or width < wanted_width:
            raise ValueError(
                f"frames of {width}x{height} hold no window of {wanted_width}x{wanted_height}: "
                "give a smaller data.size, or data.fit cover"
            )
        return size
    factor = max(wanted_height / height, wanted_width / width)
    return max(wanted_height, round(height * factor)), max(wanted_width, round(width * factor))


def scaled(batch: Tensors, height: int, width: int) -> Tensors:
    """The batch at another size: frames by area, ground truth by the nearest pixel with its vectors scaled.

    The same resampling as ``FramePair.resized``, which says why.
    """
    old_height, old_width = batch["flow"].shape[2:]
    if (old_height, old_width) == (height, width):
        return batch
    device = batch["flow"].device
    vertical = torch.from_numpy(resampling_weights(old_height, height)).to(device, torch.float32)
    horizontal = torch.from_numpy(resampling_weights(old_width, width)).to(device, torch.float32)
    rows = torch.from_numpy(nearest_pixels(old_height, height)).to(device)
    columns = torch.from_numpy(nearest_pixels(old_width, width)).to(device)
    factors = torch.tensor([width / old_width, height / old_height], device=device).view(1, 2, 1, 1)
    result = {}
    for name, value in batch.items():
        if name in ("frame1", "frame2"):
            exact = vertical @ value.float() @ horizontal.T
            result[name] = exact.round_().clamp_(0, 255).to(torch.uint8)
        else:
            picked = value[:, :, rows][:, :, :, columns]
            result[name] = picked * factors if name.endswith("flow") else picked
    return result


def cropped(batch: Tensors, window: tuple[int, int], seeds: Sequence[int] | None = None) -> Tensors:
    """A ``window`` (height, width) of each pair: at a place that follows from the pair's seed, or the central one."""
    height, width = batch["flow"].shape[2:]
    room = (height - window[0], width - window[1])
    if room == (0, 0):
        return batch
    if seeds is None:
        top, left = room[0] // 2, room[1] // 2
        return {name: value[..., top : top + window[0], left : left + window[1]] for name, value in batch.items()}
    corners = [_corner(room, seed) for seed in seeds]
    return {
        name: torch.stack(
            [value[i, :, y : y + window[0], x : x + window[1]] for i, (y, x) in enumerate(corners)]
        )
        for name, value in batch.items()
    }  # fmt: skip


def _corner(room: tuple[int, int], seed: int) -> tuple[int, int]:
    random = torch.Generator().manual_seed(seed)
    y, x = (int(torch.randint(0, span + 1, (), generator=random)) for span in room)
    return y, x
