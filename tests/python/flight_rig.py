# SPDX-License-Identifier: MIT
"""What the flight program's tests fly with: a scripted autopilot (pymavlink), a camera made of files, faulty models."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from ajna.flight_program import SpoolFolder, is_ready
from ajna.mavlink_vehicle import MavlinkVehicle

WIDTH, HEIGHT = 64, 48
SWITCH = 8
OVERRIDE_RATE_US_S = 2000.0
NAN_MARK, SLOW_MARK = 255, 254

CONFIG = """
model: {{path: "{model}", threads: 1, width_px: 64, height_px: 48{deadline}}}
source: {{kind: spool, path: "{frames}"}}
mavlink: {{endpoint: "{endpoint}"}}
safety: {{switch_channel: 8{timeouts}}}
task: {{kind: navigate}}
log: {{folder: "{log}"}}
"""
# For tests of something else than time: a busy machine is no fault there.
PATIENT = (
    ", rc_timeout_s: 1.0, camera_timeout_s: 1.0, command_timeout_s: 1.0, max_tick_s: 0.5, heartbeat_timeout_s: 3.0"
)


class Autopilot(MavlinkVehicle):
    """A vehicle that is scripted by the test and remembers what it was told.

    ``overrides`` and ``releases`` are the times at which RC_CHANNELS_OVERRIDE messages came that override channel 1, or
    release it; ``heard`` is every message with its time; ``unsafe``: overrides at a time when there should be none.
    """

    def __init__(self) -> None:
        self.heard: list[tuple[float, Any]] = []
        self.overrides: list[float] = []
        self.releases: list[float] = []
        self.pulses: list[tuple[float, list[int]]] = []
        self.unsafe: list[str] = []
        self._changed_s = 0.0
        super().__init__(SWITCH)

    def ready(self, armed: bool = True, mode: int = mavlink.COPTER_MODE_LOITER) -> None:
        self.armed, self.mode = armed, mode
        self._changed_s = time.monotonic()

    def _take(self, now: float, message: Any) -> None:
        self.heard.append((now, message))
        super()._take(now, message)

    def _override(self, now: float, wire: list[int]) -> None:
        super()._override(now, wire)
        if self.overridden:
            self.overrides.append(now)
            self.pulses.append((now, list(self.channels)))
            allowed = self.armed and self.mode == mavlink.COPTER_MODE_LOITER and self.switch_us > 1700
            if not allowed and now - self._changed_s > 0.2:
                self.unsafe.append(f"armed {self.armed}, mode {self.mode}, switch {self.switch_us}")
        else:
            self.releases.append(now)

    def set_switch(self, pulse_us: int) -> None:
        self.switch_us = pulse_us
        self._changed_s = time.monotonic()


class SpoolCamera:
    """Moves frames into a folder at 30 Hz. ``mark`` goes into the first pixel, where faulty models look for it."""

    def __init__(self, folder: Path) -> None:
        self._spool = SpoolFolder(folder)
        self.stalled = False
        self.damaged = False
        self.mark = 0
        random = np.random.default_rng(0)
        self._image: NDArray[np.uint8] = random.integers(0, 250, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop = True
        self._thread.join()

    def _run(self) -> None:
        index = 0
        while not self._stop:
            time.sleep(1 / 30)
            if self.stalled:
                continue
            image = np.roll(self._image, index, axis=1)
            image[0, 0] = self.mark
            data = f"P6 {WIDTH} {HEIGHT} 255\n".encode() + image.tobytes()
            self._spool.put_bytes(index, data[:500] if self.damaged else data)
            index += 1


class _Faulty(torch.nn.Module):
    """A model that fails on marked frames."""

    def __init__(self, inner: torch.jit.ScriptModule) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, frame1: torch.Tensor, frame2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return self.predict(frame1, frame2)

    @torch.jit.export
    def predict(self, frame1: torch.Tensor, frame2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        flow, uncertainty, error = self.inner.predict(frame1, frame2)
        mark = int(frame1[0, 0, 0, 0])  # the newest frame: pairs go back in time
        if mark == 255:
            flow = flow * float("nan")
        if mark == 254:
            x = torch.eye(300)
            for _ in range(2000):
                x = x @ x
            flow = flow * x[0, 0]
        return flow, uncertainty, error


class _Constant(torch.nn.Module):
    """A model whose answer says nothing, or is none."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def forward(self, frame1: torch.Tensor, frame2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return self.predict(frame1, frame2)

    @torch.jit.export
    def predict(self, frame1: torch.Tensor, frame2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        plane = torch.full([frame1.size(0), 2, frame1.size(2), frame1.size(3)], self.value)
        return plane, plane + 1.0, plane + 1.0


def _save(model: torch.nn.Module, like: Path, path: Path) -> Path:
    """``model`` with the metadata of the TorchScript file ``like``."""
    metadata = {"ajna.json": ""}
    torch.jit.load(like, _extra_files=metadata)
    torch.jit.script(model).save(str(path), _extra_files=metadata)
    return path


def faulty_model(script: Path, path: Path) -> Path:
    return _save(_Faulty(torch.jit.load(script)), script, path)


def constant_model(script: Path, path: Path, value: float) -> Path:
    return _save(_Constant(value), script, path)


def wait_for(condition: Callable[[], bool], seconds: float) -> bool:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.002)
    return condition()


class Bridge:
    """Bytes between a stream, which the program opens, and the autopilot's UDP port, in a thread.

    Streams cut messages where they like: here after every 7 bytes.
    """

    endpoint: str

    def __init__(self, port: int) -> None:
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.connect(("127.0.0.1", port))
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        self._udp.close()

    def _descriptor(self) -> int | None:
        """Of the open stream, or None."""
        raise NotImplementedError

    def _lost(self) -> None:
        """The other side closed the stream."""

    def _run(self) -> None:
        while not self._stop:
            stream = self._descriptor()
            ready = select.select([self._udp] if stream is None else [self._udp, stream], [], [], 0.01)[0]
            try:
                if stream is not None and stream in ready:
                    data = os.read(stream, 4096)
                    if data:
                        self._udp.send(data)
                    else:
                        self._lost()
                if self._udp in ready:
                    data = self._udp.recv(4096)
                    for begin in range(0, len(data) if stream is not None else 0, 7):
                        os.write(stream, data[begin : begin + 7])  # type: ignore[arg-type]
            except OSError:
                self._lost()


class TcpBridge(Bridge):
    """Waits for the program's connection; ``hang_up`` ends it, and nobody answers until ``answer``."""

    def __init__(self, port: int) -> None:
        self._connection: socket.socket | None = None
        self._tcp_port = 0
        self.answer()
        self.endpoint = f"tcp:127.0.0.1:{self._tcp_port}"
        super().__init__(port)

    def answer(self) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self._tcp_port))
        listener.listen(1)
        listener.settimeout(0)
        self._tcp_port = listener.getsockname()[1]
        self._listener: socket.socket | None = listener

    def hang_up(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()
        self._lost()

    def close(self) -> None:
        super().close()
        self.hang_up()

    def _descriptor(self) -> int | None:
        if self._connection is None and self._listener is not None:
            try:
                self._connection = self._listener.accept()[0]
            except OSError:
                return None
        return None if self._connection is None else self._connection.fileno()

    def _lost(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


class SerialBridge(Bridge):
    """A pseudo-terminal in place of a serial port."""

    def __init__(self, port: int) -> None:
        self._near, self._far = os.openpty()
        self.endpoint = f"serial:{os.ttyname(self._far)}:115200"
        super().__init__(port)

    def close(self) -> None:
        super().close()
        os.close(self._near)
        os.close(self._far)

    def _descriptor(self) -> int | None:
        return self._near


class Rig:
    """A running program with its autopilot and its camera."""

    def __init__(
        self,
        program: Path,
        folder: Path,
        model: Path,
        *arguments: str,
        patient: bool = True,
        timeouts: str | None = None,
        bridge: Callable[[int], Bridge] | None = None,
        **popen: Any,
    ) -> None:
        frames = folder / "frames"
        frames.mkdir()
        self.autopilot = Autopilot()
        self.bridge = bridge(self.autopilot.port) if bridge else None
        self.camera = SpoolCamera(frames)
        self.log = folder / "log"
        config = folder / "flight.yaml"
        text = CONFIG.format(
            model=model,
            frames=frames,
            endpoint=self.bridge.endpoint if self.bridge else f"udpout:127.0.0.1:{self.autopilot.port}",
            log=self.log,
            deadline=", deadline_s: 1.0" if patient else "",
            timeouts=timeouts or (PATIENT if patient else ""),
        )
        config.write_text(text)
        self.stderr = folder / "stderr.txt"
        with self.stderr.open("w") as stderr:
            self.process = subprocess.Popen(
                [str(program), "--config", str(config), *arguments],
                **{"stderr": stderr, "stdout": subprocess.DEVNULL, **popen},
            )

    @property
    def said(self) -> str:
        return self.stderr.read_text()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.camera.close()
        if self.bridge:
            self.bridge.close()
        self.autopilot.close()

    def wait_until_ready(self) -> None:
        """Until only the switch is missing."""
        assert wait_for(lambda: is_ready(self.said), 30), self.said

    def activate(self) -> None:
        for _ in range(5):  # a busy machine may be too slow for a moment
            self.wait_until_ready()
            self.autopilot.set_switch(2000)
            if wait_for(lambda: self.autopilot.overridden, 1):
                time.sleep(0.3)
                if self.autopilot.overridden:
                    return
            self.autopilot.set_switch(1000)
            time.sleep(1.0)
        raise AssertionError(self.said)

    def expect_release(self, since: float) -> float:
        """The time from ``since`` to the first release; nothing may override afterwards."""
        autopilot = self.autopilot
        assert wait_for(lambda: any(t >= since for t in autopilot.releases), 2), self.said
        released = next(t for t in autopilot.releases if t >= since)
        time.sleep(0.7)
        assert not autopilot.overridden
        assert not [t for t in autopilot.overrides if t > released]
        repeats = [t for t in autopilot.releases if t >= released]
        assert len(repeats) >= 5, "a release that is lost must have followers"
        return released - since
