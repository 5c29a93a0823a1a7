# SPDX-License-Identifier: MIT
"""The flight program itself as a method: it reads frames from a folder and flies the simulated vehicle by MAVLink.

The simulation is the vehicle here: an ArduPilot copter in LOITER that takes overridden sticks, as on the paper's
vehicle. The program's clock runs slower than time (``simulation.time_scale``), so that rendering can keep up; by that
clock it flies as on a robot, with its own latency, time-outs and limits. So trials are not repeatable to the last bit.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ajna.flight_program import SpoolFolder, find_program, is_ready, memory_folder
from ajna.model import checkpoint_path
from ajna.sim.methods.skills import COAST_S, Autopilot
from ajna.sim.observation import Observation, Output, TaskSetup
from ajna.sim.vehicle import CAMERA_AHEAD_M, Command

__all__ = ["FlightProgram"]

Floats = NDArray[np.float64]

TRIM_US = 1500.0
LOITER_M_S = 6.0  # what a full stick asks for
LOITER_RAD_S = 2.0
HOLD_US = 3.0  # sticks nearer to the middle than this hold the position
# From the middle of the exposure until a frame is read out and has been sent: a camera on USB takes no less.
CAMERA_LATENCY_S = 0.012
# Of the frames of a trial may be late: then the program's clock and the world's have come apart.
LATE_SHARE = 0.2

CONFIG = """
model: {{path: "{model}", threads: 1, width_px: {width}, height_px: {height}}}
source: {{kind: spool, path: "{frames}", latency_s: {latency}}}
mavlink: {{endpoint: "udpout:127.0.0.1:{port}"}}
output:
  rc:
    right: {{channel: 1, us_per_m_s: {per_m_s}, min_us: 1000, max_us: 2000, rate_us_s: 20000}}
    forward: {{channel: 2, us_per_m_s: -{per_m_s}, min_us: 1000, max_us: 2000, rate_us_s: 20000}}
    up: {{channel: 3, us_per_m_s: {per_m_s}, min_us: 1000, max_us: 2000, rate_us_s: 20000}}
    yaw: {{channel: 4, us_per_rad_s: {per_rad_s}, min_us: 1000, max_us: 2000, rate_us_s: 20000}}
safety: {{switch_channel: 8}}
task:
  kind: {task}
  horizontal_fov_rad: {fov}
  planning_rate_hz: {rate}
  navigate: {{speed_m_s: {speed}, camera_ahead_m: {ahead}}}
  gap: {{forward_m_s: {speed}, coast_m_s: {speed}, coast_duration_s: {coast}}}
log: {{folder: "{log}"}}
simulation: {{time_scale: {scale}}}
"""


def _time_scale() -> float:
    text = os.environ.get("AJNA_FLIGHT_TIME_SCALE", "0.08")
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not 0.01 <= scale <= 1.0:
        raise ValueError(f"AJNA_FLIGHT_TIME_SCALE is '{text}': give 0.01 to 1")
    return scale


class FlightProgram:
    """``ajna_flight`` as a method of the simulation; :meth:`close` it.

    Args:
        weights: a model file of Ajna's; None: the shipped one.
        program: its file; see :func:`ajna.flight_program.find_program`.
        time_scale: how fast its clock runs against time; None: the variable AJNA_FLIGHT_TIME_SCALE, or 0.08.
        log: a folder for its flight logs, which are otherwise not kept.

    Raises:
        FileNotFoundError: there is no such program or model.
        ValueError: pymavlink is missing, or the time scale is out of range.
    """

    name = "flight"
    tasks = frozenset({"navigate", "gap", "dodge"})
    needs = frozenset({"rgb"})
    shows_masks = False

    def __init__(
        self,
        weights: str | Path | None = None,
        program: str | Path | None = None,
        time_scale: float | None = None,
        log: Path | None = None,
    ) -> None:
        self._program = find_program(program)
        self._model = Path(weights) if weights is not None else checkpoint_path("best")
        self._scale = time_scale if time_scale is not None else _time_scale()
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def reset(self, setup: TaskSetup) -> None:
        """Start the program for a trial."""
        try:
            from ajna.mavlink_vehicle import MavlinkVehicle
        except ImportError as error:
            raise ValueError("method 'flight' needs pymavlink: pip install pymavlink") from error
        self.close()
        self._setup = setup
        self._folder = Path(tempfile.mkdtemp(prefix="ajna-flight-", dir=memory_folder()))
        frames = self._folder / "frames"
        frames.mkdir()
        self._camera = SpoolFolder(frames)
        log = self._log or self._folder / "log"
        log.mkdir(parents=True, exist_ok=True)
        self._vehicle = MavlinkVehicle(time_scale=self._scale)
        self._vehicle.attitude_every_s = None
        camera = setup.camera
        config = self._folder / "flight.yaml"
        config.write_text(
            CONFIG.format(
                model=self._model,
                width=camera.width,
                height=camera.height,
                frames=frames,
                latency=CAMERA_LATENCY_S,
                port=self._vehicle.port,
                per_m_s=500 / LOITER_M_S,
                per_rad_s=500 / LOITER_RAD_S,
                task=setup.task,
                fov=camera.horizontal_fov_rad,
                rate=camera.rate_hz,
                speed=max(setup.speed_m_s, 0.1),
                ahead=CAMERA_AHEAD_M,
                coast=COAST_S,
                log=log,
                scale=self._scale,
            )
        )
        self._said = self._folder / "said.txt"
        with self._said.open("w") as said:
            self._process = subprocess.Popen(
                [str(self._program), "--config", str(config)], stdout=subprocess.DEVNULL, stderr=said
            )
        self._autopilot = Autopilot()
        self._count = self._late = 0
        self._slot: float | None = None
        self._before: tuple[float, Floats] | None = None
        self._moved = False

    def __call__(self, observation: Observation) -> Output:
        if self._slot is None:
            self._take_off(observation)
        # One slot of its clock per frame; what comes later than its slot is counted.
        now = time.monotonic()
        assert self._slot is not None
        if now > self._slot + 0.3 * self._frame_s:
            self._late += 1
            self._slot = now
        time.sleep(max(0.0, self._slot - now))
        self._slot += self._frame_s
        self._count += 1
        if self._count > 20 and self._late > LATE_SHARE * self._count:
            raise RuntimeError(
                f"{self._late} of {self._count} frames were rendered too late: this machine is too slow, or too busy, "
                f"for a time scale of {self._scale}; give a smaller one by AJNA_FLIGHT_TIME_SCALE"
            )
        self._deliver(observation)
        command = self._sticks()
        # Only a dodge begins with a detection: the others move from the start.
        decided = self._setup.task == "dodge" and command is not None and not self._moved
        self._moved = self._moved or decided
        return Output(None, None, self._autopilot(command, observation), decided, planned=False)

    @property
    def _frame_s(self) -> float:
        return 1.0 / self._setup.camera.rate_hz / self._scale

    @property
    def said(self) -> str:
        """What the program has written so far."""
        return self._said.read_text()

    def _take_off(self, observation: Observation) -> None:
        """The world stands still until the program has met the autopilot and is active."""
        self._wait(lambda: is_ready(self.said), observation, "ready")
        self._vehicle.switch_us = 2000
        self._wait(lambda: self._vehicle.overridden, observation, "active")
        self._slot = time.monotonic()

    def _wait(self, condition: Callable[[], bool], observation: Observation, what: str) -> None:
        until = time.monotonic() + 60.0
        while not condition():
            if time.monotonic() > until or self._process is None or self._process.poll() is not None:
                raise RuntimeError(f"the flight program did not become {what}; it said:\n{self.said}")
            self._deliver(observation)
            time.sleep(self._frame_s / 2)

    def _deliver(self, observation: Observation) -> None:
        """What the vehicle's sensors say of a frame's time, and then the frame, as late as a camera sends it."""
        self._clock_s = time.monotonic() * self._scale
        self._send_motion(observation)
        time.sleep(CAMERA_LATENCY_S / self._scale)
        self._camera.put(observation.frame.index, observation.rgb)

    def _send_motion(self, observation: Observation) -> None:
        heading = observation.heading_from_camera[:, [2, 0, 1]]  # body axes, which are the camera's: forward first
        yaw = -observation.yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        north = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        body = north @ heading
        pitch = float(np.arcsin(np.clip(-body[2, 0], -1, 1)))
        roll = float(np.arctan2(body[2, 1], body[2, 2]))
        time_s = observation.frame.time_s
        rates = np.zeros(3)
        if self._before is not None and time_s > self._before[0]:
            turn = self._before[1].T @ body
            rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / (time_s - self._before[0])
        self._before = (time_s, body)
        velocity = north @ observation.velocity_m_s
        self._vehicle.send_motion(
            self._clock_s,
            (roll, pitch, float(np.arctan2(body[1, 0], body[0, 0]))),
            (float(rates[0]), float(rates[1]), float(rates[2])),
            (float(velocity[0]), float(velocity[1]), float(velocity[2])),
        )

    def _sticks(self) -> Command | None:
        """What LOITER makes of the overridden sticks; None: nothing asked for, or released."""
        right, back, up, yaw = ((pulse or TRIM_US) - TRIM_US for pulse in self._vehicle.channels[:4])
        if max(abs(right), abs(back), abs(up), abs(yaw)) < HOLD_US:
            return None
        scale = LOITER_M_S / 500
        return Command((-back * scale, right * scale, -up * scale), yaw * LOITER_RAD_S / 500)

    def close(self) -> None:
        """End the program and remove its files."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(5 + 2 / self._scale)  # it releases for half a second of its own clock
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None
        self._vehicle.close()
        shutil.rmtree(self._folder, ignore_errors=True)
