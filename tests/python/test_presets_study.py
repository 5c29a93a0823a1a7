# SPDX-License-Identifier: MIT
"""The study of held-out scenes by preset: what is scored, by whom, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torchmetrics")

from ajna import synth
from ajna.baselines import Aligned, BaselineField, ZeroFlow
from ajna.baselines.aligned import carried
from ajna.cli import main
from ajna.data.synthetic import SyntheticScenes
from ajna.studies.presets import COLUMNS, PresetOptions, markdown, run

OPTIONS = PresetOptions(scenes=3, seed=4, width=96, height=80, presets=("gap", "dodge"))


class Known:
    """Gives the true flow of the study's scenes, and is uncertain where motion jumps."""

    def __init__(self) -> None:
        self.fields = {}
        for preset in OPTIONS.presets:
            scenes = SyntheticScenes(
                OPTIONS.scenes, OPTIONS.width, OPTIONS.height, seed=OPTIONS.seed, scene={"preset": preset}
            )
            for pair in scenes.pairs():
                rim = np.where(pair.motion_boundary | pair.occlusion, 1.0, 0.1).astype(np.float32)
                self.fields[pair.frame1.tobytes()] = BaselineField(pair.flow, np.stack([rim, rim], -1))

    def __call__(self, frame1: np.ndarray, frame2: np.ndarray) -> BaselineField:
        return self.fields[frame1.tobytes()]


def test_every_preset_and_method_is_scored_on_the_same_scenes() -> None:
    shares: list[float] = []
    rows = run({"known": Known(), "zero": ZeroFlow()}, OPTIONS, shares.append)
    assert [(row.preset, row.method) for row in rows] == [
        ("gap", "known"), ("gap", "zero"), ("dodge", "known"), ("dodge", "zero"),
        ("all presets", "known"), ("all presets", "zero"),
    ]  # fmt: skip
    gap, dodge, both = rows[1::2]
    assert both.mean.epe == pytest.approx((gap.mean.epe + dodge.mean.epe) / 2)
    ratios = [row.mean.pooled_boundary_ratio for row in (gap, dodge, both)]
    assert min(ratios[:2]) <= ratios[2] <= max(ratios[:2])
    low, high = both.interval["pooled_boundary_ratio"]
    assert low <= ratios[2] <= high
    assert shares[-1] == 1.0 and shares == sorted(shares)
    for known, zero in zip(rows[::2], rows[1::2], strict=True):
        assert known.mean.epe == 0.0 and zero.mean.epe == pytest.approx(zero.mean.zero_epe)
        assert known.mean.zero_epe == zero.mean.zero_epe
        assert known.mean.motion_boundary_auc > 0.9
        low, high = zero.interval["epe"]
        assert low <= zero.mean.epe <= high
    assert json.loads(json.dumps([row.record() for row in rows]))[0]["mean"]["epe"] == 0.0
    table = markdown(rows, OPTIONS)
    assert all(heading in table for heading, _, _ in COLUMNS.values())
    assert table.count("\n| ") == 1 + len(rows) and "| – |" in table  # nothing is calibrated here


class Still:
    """What is left of the motion is none."""

    def __call__(self, frame1: np.ndarray, frame2: np.ndarray) -> BaselineField:
        self.difference = np.abs(frame1.astype(np.float32) - frame2).mean(axis=2)
        return BaselineField(np.zeros((*frame1.shape[:2], 2), np.float32), np.stack([self.difference] * 2, -1))


def test_aligned_pairs_lose_the_motion_of_the_largest_plane() -> None:
    scenes = SyntheticScenes(1, 320, 240, seed=4, scene={"preset": "gap"})
    frame = next(iter(scenes.pairs())).frame1
    moved = np.roll(frame, (3, -7), axis=(0, 1))
    still = Still()
    field = Aligned(still)(frame, moved)
    inside = np.s_[20:-20, 20:-20]
    assert np.abs(field.flow[inside] - (-7.0, 3.0)).max() < 0.1  # the homography's motion is in the flow
    assert field.uncertainty[inside].mean() < 2.0 < 0.3 * np.abs(frame.astype(np.float32) - moved).mean()
    assert field.uncertainty.shape == field.expected_error.shape == (240, 320, 2)
    flat = np.full_like(frame, 90)
    assert isinstance(Aligned(still)(flat, flat), BaselineField) and not still.difference.any()  # no plane: as it is


def test_flow_is_carried_by_a_homography() -> None:
    flow = np.random.default_rng(0).normal(0.0, 5.0, (24, 32, 2)).astype(np.float32)
    homography = np.array([[1.1, 0.02, -3.0], [-0.01, 0.9, 2.0], [1e-4, -2e-4, 1.0]])
    got = carried(flow, homography)
    for x, y in ((0, 0), (31, 23), (10, 5)):
        end = homography @ (x + flow[y, x, 0], y + flow[y, x, 1], 1.0)
        assert np.allclose((x, y) + got[y, x], end[:2] / end[2], atol=1e-4)


def test_command_and_errors(tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["study", "presets", "--model", str(tiny_checkpoint), "--scenes", "2", "--size", "64x48"]
    assert main([*command, "--preset", "pile", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["preset"] == "pile" and row["mean"]["epe"] > 0
    assert main([*command, "--preset", "gap", "--align", "--json"]) == 0
    names = [row["method"] for row in json.loads(capsys.readouterr().out)]
    assert names == [str(tiny_checkpoint), f"{tiny_checkpoint}-aligned"]
    assert main([*command, "--preset", "piles"]) == 2
    assert "unknown scene preset 'piles'; known: general" in capsys.readouterr().err
    with pytest.raises(ValueError, match="at least 2 scenes"):
        PresetOptions(scenes=1)
    assert set(PresetOptions().presets) == set() and "gap" in synth.presets()
