# SPDX-License-Identifier: MIT
"""Fit, judge, and save: :func:`fit` and its result."""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ajna import _core, nn
from ajna._core import Calibration, CheckpointMetadata, ConformalFit, ExpectedErrorFit
from ajna.calibration.held_out import HeldOut, as_tensor
from ajna.data.dataset import BAD_SAMPLE_ERRORS
from ajna.data.frame_pair import FramePair

#: Shares for which intervals are fitted, as far as the number of images allows.
DEFAULT_LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)

#: Of the images: for the expected error, for the intervals, held out.
DEFAULT_SHARES = (0.4, 0.4, 0.2)

OnPair = Callable[[int, int, str], None]


class PairSource(Protocol):
    """What can be calibrated on: a :class:`ajna.data.dataset.FlowDataset`, or anything with these two."""

    @property
    def names(self) -> tuple[str, ...]: ...
    def read(self, index: int) -> FramePair: ...


@dataclass
class CalibrationResult:
    """A calibrated model that is not yet saved, and how it does on the held-out part.

    Attributes:
        metadata: the checkpoint's, with the new table and calibration.
        before, after: reliability and coverage on the held-out images, with the old and the new calibration.
        images: how many were used for "expected_error", "intervals" and "held_out".
        skipped_levels: default levels that would need more images.
        bad: unreadable images (with skip_bad), and why.
    """

    metadata: CheckpointMetadata
    before: HeldOut
    after: HeldOut
    images: dict[str, int]
    skipped_levels: tuple[float, ...] = ()
    bad: dict[str, str] = field(default_factory=dict)
    _net: Any = None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the calibrated checkpoint (``.safetensors``), atomically.

        Raises:
            ValueError, FileNotFoundError, RuntimeError: a path that cannot be written.
        """
        _core.save_checkpoint(os.fspath(path), self._net, self.metadata)

    def to_json(self) -> dict[str, Any]:
        """Plain keys and numbers."""
        calibration = self.metadata.calibration
        assert calibration is not None
        return {
            "model": self.metadata.name,
            "images": self.images,
            "bad_images": self.bad,
            "levels": calibration.factors.levels,
            "factors": [list(pair) for pair in calibration.factors.factors],
            "skipped_levels": list(self.skipped_levels),
            "provenance": calibration.provenance,
            "held_out": {"before": self.before.to_json(), "after": self.after.to_json()},
        }


@dataclass
class _Sample:
    raw: Tensor  # [2, H, W]
    flow: Tensor  # [2, H, W] px
    truth: Tensor  # [2, H, W] px
    valid: Tensor  # bool [H, W]


class _Runner:
    """The network over a source of pairs, one at a time."""

    def __init__(
        self, model: str | os.PathLike[str], pairs: PairSource, size: tuple[int, int] | None, device: str
    ) -> None:
        from ajna.model import checkpoint_path

        self.core, self.metadata = _core.load_checkpoint(checkpoint_path(model))
        if self.core.config.in_channels != 6 or self.core.config.out_channels != 4:
            raise ValueError(
                f"model '{os.fspath(model)}' is not one from two RGB frames (6 channels) to flow and uncertainty (4)"
            )
        self.net = nn.FlowNet._from_core(self.core).to(device)
        self.pairs, self.size, self.device = pairs, size, device
        self.skip_bad = bool(getattr(pairs, "skip_bad", False))
        self.bad: dict[str, str] = {}

    def samples(self, indices: Sequence[int], progress: Callable[[str], None]) -> Iterator[_Sample]:
        for index in indices:
            progress(self.pairs.names[index])
            try:
                pair = self.pairs.read(index)
            except BAD_SAMPLE_ERRORS as error:
                if not self.skip_bad:
                    raise
                self.bad[self.pairs.names[index]] = str(error)
                continue
            pair = pair if self.size is None else pair.resized(*self.size)
            if pair.flow is not None and pair.valid is not None and pair.valid.any():
                yield self._run(pair)

    @torch.no_grad()
    def _run(self, pair: FramePair) -> _Sample:
        frames = (as_tensor(np.ascontiguousarray(frame), self.device)[None] for frame in (pair.frame1, pair.frame2))
        output = self.net(nn.network_input(*frames))[0].float()
        assert pair.flow is not None and pair.valid is not None
        return _Sample(
            output[2:4],
            output[:2] * self.metadata.flow_scale,
            as_tensor(np.ascontiguousarray(pair.flow), self.device),
            torch.from_numpy(pair.valid).to(self.device),
        )


def split(
    names: Sequence[str],
    shares: Sequence[float] = DEFAULT_SHARES,
    seed: int = 0,
    group: Callable[[str], str] | None = None,
) -> list[list[int]]:
    """Indices of the images of each part: at random, but the images of a group stay together.

    Raises:
        ValueError: shares that are not positive, or fewer groups than parts.
    """
    if len(shares) != 3 or not all(share > 0 for share in shares):
        raise ValueError(f"shares {list(shares)}: give three numbers above 0, for expected error, intervals, held-out")
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name if group is None else group(name), []).append(index)
    if len(groups) < len(shares):
        what = "images" if group is None else "groups of images"
        raise ValueError(f"calibration needs at least {len(shares)} {what}, there are {len(groups)}: give more")
    order = np.random.default_rng(seed).permutation(len(groups))
    members = [groups[name] for name in groups]
    ends = np.cumsum(shares) / sum(shares) * len(names)
    parts: list[list[int]] = [[] for _ in shares]
    part = taken = 0
    for position, chosen in enumerate(order):
        left = len(order) - position
        empty_after = len(parts) - 1 - part
        # On to the next part where this one is full, or where the rest is just enough for those still empty.
        if parts[part] and part + 1 < len(parts) and (taken >= ends[part] - 0.5 or left <= empty_after):
            part += 1
        parts[part].extend(members[chosen])
        taken += len(members[chosen])
    return [sorted(indices) for indices in parts]


def fit(
    model: str | os.PathLike[str],
    pairs: PairSource,
    *,
    levels: Sequence[float] | None = None,
    weighting: str = "image",
    shares: Sequence[float] = DEFAULT_SHARES,
    seed: int = 0,
    group: Callable[[str], str] | None = None,
    size: tuple[int, int] | None = None,
    data: str | None = None,
    device: str = "cpu",
    on_pair: OnPair | None = None,
) -> CalibrationResult:
    """Calibrate a model on pairs with ground truth that it was not trained on; see :mod:`ajna.calibration`.

    Images are read one at a time and only binned sums are kept (one bin per knot of the table for the expected error,
    bins 0.5 % wide for the scores, whose upper edge counts): memory does not grow with their number.

    Args:
        model: a shipped model's name or a checkpoint (``.safetensors``). A calibrated one is calibrated anew.
        pairs: a data set of :mod:`ajna.data`, or :class:`SyntheticScenes`. With its ``skip_bad``, unreadable images are
            left out and listed. Images without valid ground truth do not count.
        levels: shares of the intervals, rising inside (0, 1); by default those of DEFAULT_LEVELS that the number of
            images allows (0.99 needs 99 images in the second part).
        weighting: ``"image"``: each image counts alike, which the guarantee needs; ``"pixel"``: each pixel.
        shares: of the images for the expected error, the intervals, and the held-out figures.
        seed: of the random split.
        group: image name -> group; the images of a group (frames of one video) go into the same part. The finite-sample
            guarantee then is approximate, as it counts images.
        size: (width, height) to which pairs are resized first, or None for their own. Calibrate at the size at which
            the model will run.
        data: what the data are, for the checkpoint; by default what ``pairs`` says of itself.
        device: where the network runs.
        on_pair: called with (number, total, name) before each image.

    Raises:
        ValueError: too few images for a level that was asked for, no ground truth, a foreign file, or a TorchScript
            file (calibrate the checkpoint, then export it).
        FileNotFoundError: no such model.
    """
    runner = _Runner(model, pairs, size, device)
    metadata = runner.metadata
    old_table, flow_scale = metadata.table, metadata.flow_scale
    if levels is not None:
        # Refuse before minutes of work what could only fail at the end.
        _core.ConformalFactors(list(levels), [(1.0, 1.0)] * len(levels))
    error_fit = ExpectedErrorFit(old_table, flow_scale, weighting)
    interval_fit = ConformalFit(weighting)
    usable = _with_truth(pairs)
    parts = [[usable[i] for i in part] for part in split([pairs.names[i] for i in usable], shares, seed, group)]
    total, number = sum(map(len, parts)), 0

    def progress(name: str) -> None:
        nonlocal number
        number += 1
        if on_pair is not None:
            on_pair(number, total, name)

    for sample in runner.samples(parts[0], progress):
        error_fit.add(sample.raw, sample.truth - sample.flow, sample.valid)
    table = error_fit.table()
    new_table, before_table = (curve.to(torch.device(device)) for curve in (table, old_table))
    for sample in runner.samples(parts[1], progress):
        expected = new_table.evaluate(sample.raw)[1] * flow_scale
        interval_fit.add(expected, sample.truth - sample.flow, sample.valid)
    wanted = tuple(levels) if levels is not None else DEFAULT_LEVELS
    chosen = wanted if levels is not None else tuple(p for p in wanted if interval_fit.reaches(p))
    if not chosen:
        raise ValueError(
            f"{interval_fit.images} images with ground truth are too few for intervals of level {wanted[0]}: give more"
        )
    factors = interval_fit.factors(chosen)

    before = HeldOut(chosen, metadata.calibration.factors if metadata.calibration else None)
    after = HeldOut(chosen, factors)
    held_out = 0
    for sample in runner.samples(parts[2], progress):
        held_out += 1
        for figures, curve in ((before, before_table), (after, new_table)):
            expected = curve.evaluate(sample.raw)[1] * flow_scale
            figures.add(sample.flow, sample.truth, expected, sample.valid)

    images = {"expected_error": error_fit.images, "intervals": interval_fit.images, "held_out": held_out}
    described = getattr(pairs, "describe", None)
    provenance = {
        "data": data or (described() if described else type(pairs).__name__),
        "images": str(images["expected_error"] + images["intervals"]),
        "pixels": str(error_fit.pixels + interval_fit.pixels),
        "date": datetime.date.today().isoformat(),
        "images_expected_error": str(images["expected_error"]),
        "images_intervals": str(images["intervals"]),
        "images_held_out": str(held_out),
        "size": f"{size[0]}x{size[1]}" if size else "each pair's own",
        "weighting": weighting,
        "seed": str(seed),
        "ajna": _core.__version__,
    }
    if held_out:
        provenance["held_out_ece_px"] = (
            f"{before.reliability.ece.item():.4f} before, {after.reliability.ece.item():.4f} after"
        )
        covered = after.coverage
        pairs_text = zip(covered.levels.tolist(), covered.coverage.tolist(), strict=True)
        provenance["held_out_coverage"] = ", ".join(f"{share:.3f} at {level:g}" for level, share in pairs_text)
    metadata.table, metadata.calibration = table, Calibration(factors, provenance)
    runner.net.to("cpu")
    skipped = tuple(p for p in wanted if p not in chosen)
    return CalibrationResult(metadata, before, after, images, skipped, runner.bad, runner.core)


def _with_truth(pairs: PairSource) -> list[int]:
    """Indices of the pairs that can have ground truth, as far as the source tells without reading them."""
    parts = getattr(pairs, "parts", None)
    return [index for index in range(len(pairs.names)) if parts is None or "flow" in parts(index)]
