# SPDX-License-Identifier: MIT
"""An ArduPilot copter as its companion computer sees it: streams, parameters, overrides. For simulations and tests.

Needs pymavlink.
"""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

# The module itself, so that MAVLink 2 is spoken whatever MAVLINK20 says.
from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["MavlinkVehicle"]

CHANNELS = 18
_RELEASE_HIGH, _IGNORE = 65534, 65535


class MavlinkVehicle:
    """Speaks MAVLink 2 over UDP at 127.0.0.1, in a thread of its own, with whoever talks to its ``port``.

    ``channels``: the overridden pulses in microseconds, 0 where released; ``attitude_target``: the last
    SET_ATTITUDE_TARGET. ``armed``, ``mode``, ``switch_us`` and ``parameters`` may be changed at any time; while
    ``silent`` it sends nothing.

    Args:
        switch_channel: of the pilot's switch. time_scale: how fast its clock runs against time; streams keep their
            rates by that clock.
    """

    def __init__(self, switch_channel: int = 8, time_scale: float = 1.0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.004)
        self.port: int = self.socket.getsockname()[1]
        self.peer: Any = None
        self.mav = mavlink.MAVLink(self, srcSystem=1, srcComponent=1)
        self.mav.robust_parsing = True
        self.parameters = {"SYSID_MYGCS": 255.0, "RC_OVERRIDE_TIME": 1.0, "RC_OPTIONS": 32.0}
        self.armed = True
        self.mode: int = mavlink.COPTER_MODE_LOITER
        self.switch_us = 1000
        self.silent = False
        self.channels = [0] * CHANNELS
        self.attitude_target: Any = None
        self.attitude_every_s: float | None = 0.04  # None: only what send_motion is told
        self._switch_channel = switch_channel
        self._time_scale = time_scale
        self._heartbeat_s = 1.0
        self._asked: list[str] = []
        self._stop = False
        self._lock = threading.Lock()  # of sending: two threads may
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """What pymavlink calls to send."""
        if self.peer is not None and not self._stop:
            self.socket.sendto(data, self.peer)

    def close(self) -> None:
        """End the thread and the socket."""
        self._stop = True
        self._thread.join()
        self.socket.close()

    @property
    def overridden(self) -> bool:
        """Whether the first channel is."""
        return self.channels[0] != 0

    def send_motion(
        self,
        time_s: float,
        euler_rad: tuple[float, float, float],
        rates_rad_s: tuple[float, float, float],
        velocity_ned_m_s: tuple[float, float, float],
    ) -> None:
        """Send ATTITUDE and LOCAL_POSITION_NED now, stamped with the vehicle's time; set ``attitude_every_s`` to None
        first."""
        stamp_ms = round(1e3 * time_s)
        with self._lock:
            self.mav.attitude_send(stamp_ms, *euler_rad, *rates_rad_s)
            self.mav.local_position_ned_send(stamp_ms, 0.0, 0.0, 0.0, *velocity_ned_m_s)

    def _run(self) -> None:
        due = dict.fromkeys(("heartbeat", "status", "rc", "attitude"), 0.0)
        while not self._stop:
            try:
                data, self.peer = self.socket.recvfrom(4096)
            except (TimeoutError, ConnectionError):
                data = b""
            now = time.monotonic()
            for message in self.mav.parse_buffer(data) or [] if data else []:
                self._take(now, message)
            if self.silent or self.peer is None:
                continue
            every = {"heartbeat": self._heartbeat_s, "status": 0.2, "rc": 0.04, "attitude": self.attitude_every_s}
            with self._lock:
                for name, period in every.items():
                    if period is not None and (now - due[name]) * self._time_scale >= period:
                        due[name] = now
                        getattr(self, f"_send_{name}")()
                for name in self._asked:
                    if name in self.parameters:
                        self.mav.param_value_send(name.encode(), self.parameters[name], 9, 1000, 0)
                self._asked.clear()

    def _send_heartbeat(self) -> None:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        self.mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1 | armed, self.mode, 4
        )

    def _send_status(self) -> None:
        receiver = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
        self.mav.sys_status_send(receiver, receiver, receiver, 0, 12000, 0, 90, 0, 0, 0, 0, 0, 0)

    def _send_rc(self) -> None:
        channels = [pulse or 1500 for pulse in self.channels]
        channels[self._switch_channel - 1] = self.switch_us
        self.mav.rc_channels_send(0, 16, *channels, 200)

    def _send_attitude(self) -> None:
        stamp_ms = round(1e3 * time.monotonic() * self._time_scale) % 2**32
        self.mav.attitude_send(stamp_ms, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    def _take(self, now: float, message: Any) -> None:
        """A message that has come; ``now``: time.monotonic()."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_READ":
            self._asked.append(message.param_id)
        elif kind == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            if message.param1 == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                self._heartbeat_s = message.param2 * 1e-6
        elif kind == "RC_CHANNELS_OVERRIDE":
            self._override(now, [getattr(message, f"chan{i}_raw") for i in range(1, CHANNELS + 1)])
        elif kind == "SET_ATTITUDE_TARGET":
            self.attitude_target = message

    def _override(self, now: float, wire: list[int]) -> None:
        """As ArduPilot reads it: 0 releases and 65535 ignores below channel 9; 65534 releases and both ignore above."""
        for i, value in enumerate(wire):
            if value == _IGNORE or (i >= 8 and value == 0):
                continue
            released = value == 0 if i < 8 else value == _RELEASE_HIGH
            self.channels[i] = 0 if released else value
