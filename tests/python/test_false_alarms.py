# SPDX-License-Identifier: MIT
"""The study of dodges of nothing: what it counts, on signals that see everything, nothing, or change of light."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from ajna import tasks
from ajna.sim import make_world
from ajna.sim.camera import CameraModel
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.worlds import World
from ajna.studies.false_alarms import CONDITIONS, FalseAlarmOptions, markdown, run

try:
    rendering_backend()
except NoRenderingError as error:
    pytest.skip(str(error), allow_module_level=True)

CAMERA = CameraModel(width=160, height=120, subframes=1, render_scale=1)
OPTIONS = FalseAlarmOptions(rooms=2, seed=3, duration_s=1.0)


def room(seed: int) -> World:
    return make_world("dodge", seed, CAMERA)


class Moving:
    """Uncertain is a disc that moves on, whatever is seen."""

    needs = frozenset({"rgb"})

    def __init__(self, contrast: float) -> None:
        self.contrast = contrast

    def adapt(self, options: tasks.SkillOptions) -> None: ...

    def source(self, camera: CameraModel):
        def seen(first: tasks.Snapshot, second: tasks.Snapshot, common: str) -> np.ndarray:
            y, x = np.mgrid[: camera.height, : camera.width]
            disc = np.hypot(x - 35 - 90 * first.time_s, y - 60) <= 10
            return np.where(disc, self.contrast, 0.2).astype(np.float32)

        return seen


def test_counts_alarms_and_detections() -> None:
    for contrast, expected in ((1.6, True), (0.2, False)):
        conditions = run(Moving(contrast), OPTIONS, room)
        assert [condition.name for condition in conditions] == list(CONDITIONS)
        for condition in conditions:
            assert condition.alarms == [expected] * 2
            assert all((share > 0.9) == expected for share in condition.detections)
            record = condition.record()
            assert record["rooms"] == 2 and record["false_alarm_rate"] == float(expected)
    table = markdown(conditions, OPTIONS).splitlines()
    assert len(table) == 2 + len(CONDITIONS) and "2 rooms" in table[0]


def test_lights_do_what_they_say() -> None:
    frame = np.full((60, 80, 3), 100, np.uint8)

    def shown(name: str) -> list[np.ndarray]:
        return [CONDITIONS[name](frame, i / 30, np.random.default_rng(5)) for i in range(60)]

    assert all((seen == frame).all() for seen in shown("steady light"))
    blinking = [float(seen.mean()) for seen in shown("room light blinks")]
    assert set(blinking) == {60.0, 100.0} and np.count_nonzero(np.diff(blinking)) >= 3
    lamp = [seen != frame for seen in shown("a lamp blinks")]
    assert 0 < lamp[0].mean() < 0.2, "on at first, and small"
    assert not lamp[-1].any() or any(not seen.any() for seen in lamp)
    jump = [float(seen.mean()) for seen in shown("exposure jumps")]
    assert np.count_nonzero(np.diff(jump)) == 1 and jump[-1] in (50.0, 200.0)


def test_impossible_options() -> None:
    with pytest.raises(ValueError, match="at least one"):
        run(Moving(1.0), FalseAlarmOptions(rooms=0), room)
