# SPDX-License-Identifier: MIT
"""The law between uncertainty along the horizon and distance: what was put in is found again."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from ajna import tasks
from ajna.cli import main
from ajna.sim import make_world
from ajna.sim.camera import CameraModel
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.methods.signals import TrueMotionSignal
from ajna.sim.worlds import World
from ajna.studies.horizon import Columns, Law, columns_of, fit, markdown, quality, run

FOV = np.deg2rad(80.0)
LEVEL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
LAW = Law(0.3, 0.02, 40.0)


def columns(law: Law, noise: float = 0.0, count: int = 4000) -> Columns:
    """Columns of a network that keeps to a law, but for noise and, every tenth, a value drawn at random."""
    random = np.random.default_rng(5)
    distance = np.where(random.random(count) < 0.3, np.inf, random.uniform(1.0, 12.0, count))
    shift, move = random.uniform(0, 160, count), random.uniform(0.2, 0.5, count)
    closing = move / distance
    uncertainty = law.floor + law.per_px * (shift + law.least_shift_px) * closing
    if noise:
        uncertainty = uncertainty + random.normal(0, noise, count)
        uncertainty[::10] = random.uniform(0, 5, len(uncertainty[::10]))
    return Columns(uncertainty, shift, closing, distance, np.ones(count), move)


def test_the_law_is_found_again() -> None:
    exact = fit(columns(LAW))
    assert (exact.floor, exact.per_px, exact.least_shift_px) == pytest.approx((0.3, 0.02, 40.0), rel=1e-6)
    noisy = fit(columns(LAW, 0.05))
    assert (noisy.floor, noisy.per_px, noisy.least_shift_px) == pytest.approx((0.3, 0.02, 40.0), rel=0.1)


def test_least_shift_is_not_negative() -> None:
    """Where the best law would see less than a pixel's motion, the best with none is taken."""
    law = fit(columns(Law(0.5, 0.02, -12.0)))
    assert law.least_shift_px == 0.0 and law.per_px > 0


def test_quality_of_a_law() -> None:
    seen = columns(LAW)
    right = quality(seen, LAW)
    assert right["missed"] == right["false"] == 0.0 and right["ratio"] == pytest.approx([1.0] * 3)
    assert quality(seen, Law(0.3, 0.04, 40.0))["ratio"] == pytest.approx([2.0] * 3)
    assert quality(seen, Law(9.0, 0.02, 40.0))["missed"] == 1.0
    assert quality(seen, Law(0.0, 1e-4, 40.0))["false"] == 1.0


def test_a_map_that_says_nothing_of_distance_is_refused() -> None:
    seen = columns(LAW)
    with pytest.raises(ValueError, match="does not grow with what comes near"):
        fit(dataclasses.replace(seen, uncertainty=2.0 - seen.uncertainty))
    with pytest.raises(ValueError, match="too few"):
        fit(columns(LAW, count=40))


@pytest.mark.parametrize("move", [(0.4, 0.0, 0.0), (0.3, -0.1, 0.05)])
def test_columns_of_a_wall(move: tuple[float, float, float]) -> None:
    """A wall across the way: its depth, and the mean uncertainty of each column, under a tilted camera, too."""
    tilt = np.deg2rad(10.0)
    turned = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    options = tasks.HorizonOptions()
    for attitude in (LEVEL, LEVEL @ turned):
        map_ = np.tile(np.linspace(0.2, 1.8, 160, dtype=np.float32), (120, 1))
        found = columns_of(map_, np.full((120, 160), 5.0, np.float32), attitude, np.array(move), options, FOV)
        assert found is not None and len(found) == 80
        # A camera that looks up or down sees upright lines lean towards the picture's sides.
        assert found.uncertainty == pytest.approx(map_[0, ::2], abs=2e-4 if attitude is LEVEL else 8e-3)
        assert found.closing == pytest.approx(np.full(80, np.linalg.norm(move) / 5.0), rel=1e-3)
        assert found.distance_m == pytest.approx(5.0 * found.per_depth, rel=1e-3)
    nothing = columns_of(map_, np.full((120, 160), np.inf, np.float32), LEVEL, np.array(move), options, FOV)
    assert nothing is not None and np.isinf(nothing.distance_m).all()
    assert columns_of(map_, np.ones((120, 160), np.float32), LEVEL, np.zeros(3), options, FOV) is None


def forest(seed: int) -> World:
    """The first second and a half of one, in small pictures."""
    camera = CameraModel(width=160, height=120, subframes=1, render_scale=1)
    return dataclasses.replace(make_world("forest", seed, camera), time_limit_s=1.6)


def test_study_on_true_motion(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """On the map that follows from depth by a law the study finds that law."""
    try:
        rendering_backend()
    except NoRenderingError as error:
        pytest.skip(str(error))
    study = run(TrueMotionSignal(), 1, 1000, forest)
    default = Law.of(tasks.HorizonOptions())
    assert study.present == default and len(study.columns) > 200
    assert study.fitted.floor == pytest.approx(default.floor, abs=0.02)
    assert study.fitted.per_px == pytest.approx(default.per_px, rel=0.1)
    assert study.fitted.least_shift_px == pytest.approx(default.least_shift_px, rel=0.15)
    text = markdown(study)
    assert "| fitted |" in text and "| from 9 |" in text and "nan" not in text
    with pytest.raises(ValueError, match="at least one"):
        run(TrueMotionSignal(), 0)

    from ajna.sim.methods import signals
    from ajna.studies import horizon

    monkeypatch.setattr(signals, "NetworkSignal", lambda model: TrueMotionSignal())
    monkeypatch.setattr(horizon, "make_world", lambda name, seed: forest(seed))
    assert main(["study", "horizon", "--forests", "1", "--seed", "1000", "--json"]) == 0
    record = json.loads(capfd.readouterr().out)
    assert record["fitted"]["per_px"] == pytest.approx(study.fitted.per_px, rel=1e-6)
    assert record["columns"] == len(study.columns)
