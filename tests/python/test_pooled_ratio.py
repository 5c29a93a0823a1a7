# SPDX-License-Identifier: MIT
"""The ratio at boundaries over the pixels of many images, and where only a mask says what is hidden."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ajna import io
from ajna.data.pairs import PairsDataset
from ajna.evaluation import evaluate
from ajna.pooled_ratio import PooledRatio

SIDE = 96
MASK = np.s_[30:60, 30:60]


def test_it_is_that_of_the_medians_of_all_pixels() -> None:
    random = np.random.default_rng(0)
    images = [(random.lognormal(1.0, 1.0, 50 * n), random.lognormal(-1.0, 1.5, 3000)) for n in range(6)]
    pooled, first, rest = PooledRatio(), PooledRatio(), PooledRatio()
    for number, (special, usual) in enumerate(images):
        pooled.add(np.append(special, np.nan), usual)
        (first if number < 2 else rest).add(special, usual)
    medians = [np.median(np.concatenate(values)) for values in zip(*images, strict=True)]
    assert pooled.ratio == pytest.approx(medians[0] / medians[1], rel=0.02)
    first.join(rest)
    assert first.ratio == pooled.ratio
    interval = pooled.interval()
    assert interval is not None and interval[0] < pooled.ratio < interval[1] and interval == pooled.interval()
    scaled = PooledRatio()
    for special, usual in images:
        scaled.add(3 * special, usual)
    assert scaled.ratio == pytest.approx(3 * pooled.ratio, rel=0.02)


def test_it_is_not_defined_without_pixels_of_both_kinds() -> None:
    pooled = PooledRatio()
    assert pooled.ratio is None and pooled.interval() is None
    pooled.add([], [1.0])
    pooled.add([np.nan], [2.0])
    assert pooled.ratio is None and pooled.interval() is None
    pooled.add([8.0], [2.0])
    assert pooled.ratio == pytest.approx(8.0 / 2.0, rel=0.03)  # of 1, 2 and 2
    one = PooledRatio()
    one.add([1e9, 1e9], [0.0])  # outside of the bins
    assert one.ratio == pytest.approx(1e8, rel=0.03) and one.interval() is None


@pytest.fixture
def sparse(tmp_path: Path) -> Path:
    """Two cases, ground truth at every fifth pixel as a laser gives it; the second has no mask of what is hidden."""
    random = np.random.default_rng(3)
    for case in ("masked", "plain"):
        (tmp_path / case).mkdir()
        for number in (1, 2):
            io.write_image(
                tmp_path / case / f"img{number}.png", random.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
            )
        flow = np.full((SIDE, SIDE, 2), 1e10, np.float32)
        flow.reshape(-1, 2)[::5] = 0.0
        (tmp_path / case / "flow.flo").write_bytes(struct.pack("<fii", 202021.25, SIDE, SIDE) + flow.tobytes())
    hidden = np.zeros((SIDE, SIDE, 3), np.uint8)
    hidden[MASK] = 255
    io.write_image(tmp_path / "masked" / "occ.png", hidden)
    return tmp_path


def doubtful(frame1: np.ndarray, frame2: np.ndarray) -> SimpleNamespace:
    """Expects four times the error in the mask, and errs six times as much."""
    expected = np.ones((SIDE, SIDE, 2), np.float32)
    expected[MASK] = 4.0
    flow = np.ones((SIDE, SIDE, 2), np.float32)
    flow[MASK] = 6.0
    return SimpleNamespace(flow=flow, uncertainty=np.sqrt(expected), expected_error=expected)


def test_where_ground_truth_is_sparse_what_the_mask_hides_counts(sparse: Path) -> None:
    report = evaluate(PairsDataset(sparse), {"doubtful": doubtful}, size=None, repeats=1).methods["doubtful"]
    masked, plain = report.cases["masked"], report.cases["plain"]
    assert masked.boundary_ratio == pytest.approx(2.0)
    assert masked.expected_boundary_ratio == pytest.approx(4.0)
    assert masked.error_boundary_ratio == pytest.approx(6.0)
    assert plain.boundary_ratio is plain.expected_boundary_ratio is plain.error_boundary_ratio is None
    assert report.mean.pooled_boundary_ratio == pytest.approx(4.0, rel=0.03)
    assert report.mean.pooled_error_boundary_ratio == pytest.approx(6.0, rel=0.03)
    assert masked.pooled_boundary_ratio is None
    # What is left out of the means of figures in pixels is left out here, too.
    for options in ({"uncertainty_only": ["masked"]}, {"exclude": ["masked"]}):
        without = evaluate(PairsDataset(sparse), {"doubtful": doubtful}, size=None, repeats=1, **options)
        assert without.methods["doubtful"].mean.pooled_boundary_ratio is None
