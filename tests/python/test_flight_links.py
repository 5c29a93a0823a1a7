# SPDX-License-Identifier: MIT
"""The flight program over streams: TCP, which can break and come back, and a serial line (a pseudo-terminal)."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

from flight_rig import Rig, SerialBridge, TcpBridge, mavlink, wait_for

BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")
PROGRAM = Path(BUILD or ".") / "cpp" / "apps" / "ajna_flight"

pytestmark = pytest.mark.skipif(
    not (BUILD and PROGRAM.is_file()), reason="ajna_flight is not built (AJNA_TEST_BUILD_DIR names the build)"
)


@pytest.fixture(params=[TcpBridge, SerialBridge], ids=["tcp", "serial"])
def rig(request: pytest.FixtureRequest, flight_script: Path, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(PROGRAM, tmp_path, flight_script, bridge=request.param)
    yield rig
    rig.close()


def test_it_flies_over_a_stream(rig: Rig) -> None:
    rig.activate()
    kinds = {message.get_type() for _, message in rig.autopilot.heard}
    assert {"HEARTBEAT", "RC_CHANNELS_OVERRIDE"} <= kinds and "BAD_DATA" not in kinds
    assert all(1000 <= pulse <= 2000 for _, pulses in rig.autopilot.pulses for pulse in pulses if pulse)
    since = time.monotonic()
    rig.autopilot.ready(mode=mavlink.COPTER_MODE_ALT_HOLD)
    rig.expect_release(since)
    assert not rig.autopilot.unsafe


@pytest.mark.parametrize("rig", [TcpBridge], indirect=True, ids=["tcp"])
def test_a_broken_connection_comes_back_released(rig: Rig) -> None:
    rig.activate()
    rig.bridge.hang_up()
    assert wait_for(lambda: "released (" in rig.said, 5), rig.said
    broken = time.monotonic()
    time.sleep(0.5)
    assert not [t for t in rig.autopilot.overrides if t > broken], "nobody can hear it"
    rig.bridge.answer()
    assert wait_for(lambda: any(t > broken for t in rig.autopilot.releases), 10), rig.said
    time.sleep(0.7)
    assert not [t for t in rig.autopilot.overrides if t > broken], "the switch was never turned off"
    rig.autopilot.set_switch(1000)
    rig.activate()
    assert rig.process.poll() is None


@pytest.mark.parametrize(("timeout_s", "warned"), [(1.0, False), (0.03, True)])
def test_a_computer_too_slow_is_told_beforehand(
    flight_script: Path, tmp_path: Path, timeout_s: float, warned: bool
) -> None:
    """Frames come every 33 ms: no command can be younger than 30 ms all the time."""
    rig = Rig(PROGRAM, tmp_path, flight_script, timeouts=f", command_timeout_s: {timeout_s}")
    try:
        assert wait_for(lambda: "a pair takes" in rig.said and "log:" in rig.said, 30), rig.said
        assert ("expect releases" in rig.said) == warned, rig.said
    finally:
        rig.close()
