# SPDX-License-Identifier: MIT
"""The flight program (``ajna_flight``) at its real rate: latency from capture to command, and memory over time.

The program flies beside a simulated autopilot on loopback, with a folder as camera, into which rendered frames are
moved. It measures its latency itself: from the arrival of a frame to the tick of the control loop that has the command
made of it. Everything else is seen from outside.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna.benchmarks.machine import describe_machine, describe_versions
from ajna.flight_log import read_log
from ajna.flight_program import SpoolFolder, is_ready, memory_folder

TASKS = ("dodge", "navigate", "gap")
SETTLE_SHARE, SETTLE_MAX_S = 0.2, 60.0  # of a turn, before its memory counts
_START_S = 60.0
_FORWARD_M_S = 3.0  # navigate looks at nothing while it stands
_ROUND = 90  # frames until the picture is back where it began

_CONFIG = """
model: {{path: "{model}", threads: {threads}, width_px: {width}, height_px: {height}}}
source: {{kind: spool, path: "{frames}"}}
mavlink: {{endpoint: "udpout:127.0.0.1:{port}"}}
safety: {{switch_channel: 8}}
task: {{kind: {task}, planning_rate_hz: {planning}}}
log: {{folder: "{log}"}}
"""

_HEADINGS = (
    "model file",
    "threads",
    "p50 ms",
    "p95 ms",
    "p99 ms",
    "longest ms",
    "frames looked at",
    "CPU, cores",
    "commanding",
    "activations",
    "memory MB, settled",
    "at the end",
    "largest",
    "MB/h, fitted",
)
_LEGEND = """\
- Latency: from the arrival of a frame (before it is decoded) to the tick of the control loop that has its command; the
  program's own histogram, in bins of 1 ms. Commanding: share of the time, sampled each second, in which the sticks were
  overridden; where it is low, commands come too late for `safety.command_timeout_s`.
- Memory: the program's resident set. Settled: after a fifth of the time, a minute at most; the growth is that of a
  straight line through all samples from there on."""


@dataclass(frozen=True)
class Memory:
    """Resident set of the program, bytes, once it has settled; the growth is a straight line's through all samples."""

    settled: int
    end: int
    largest: int
    growth_per_h: float


@dataclass(frozen=True)
class Row:
    """One model file flown with."""

    label: str
    file: str
    threads: int
    seconds: float
    frames_sent: int  # from the program's start on, as the counts below
    frames: int  # arrived
    dropped: int
    stale: int
    damaged: int
    network_failures: int
    activations: int  # 1: never released in between
    commands_sent: int
    commanding: float  # share of the time
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float
    cpu_cores: float
    memory: Memory

    @property
    def looked_at(self) -> int:
        """Frames that the network has seen as the newest of a pair."""
        return self.frames - self.dropped - self.stale


@dataclass(frozen=True)
class FlightBenchmark:
    """The table and what it depends on."""

    rows: tuple[Row, ...]
    task: str
    size: tuple[int, int]  # (width, height)
    rate_hz: float
    machine: dict[str, Any]
    load_average_after: float
    nice: int
    versions: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Plain keys and numbers."""
        return asdict(self)

    def to_markdown(self) -> str:
        """The table, and below it what it was measured with."""
        width, height = self.size
        machine = self.machine
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        nice = f", nice {self.nice}" if self.nice else ""
        return (
            "\n".join(
                [
                    "| " + " | ".join(_HEADINGS) + " |",
                    "|---" * len(_HEADINGS) + "|",
                    *("| " + " | ".join(_cells(row)) + " |" for row in self.rows),
                    "",
                    f"- `ajna_flight`, task {self.task}, frames of {width}x{height} at {self.rate_hz:g} Hz, "
                    f"{', '.join(f'{row.seconds:.0f}' for row in self.rows)} s flown.",
                    _LEGEND,
                    f"- Machine: {machine['cpu']} ({machine['capability']}), {machine['cores']} cores; load average "
                    f"{machine['load_average']:g} at the start, {self.load_average_after:g} at the end{nice}.",
                    "  Autopilot and camera are simulated on the same cores.",
                    f"- Versions: {versions}.",
                ]
            )
            + "\n"
        )


def measure(
    program: Path,
    files: Mapping[str, Path],
    *,
    task: str = "dodge",
    size: tuple[int, int] = (320, 240),
    threads: Sequence[int] = (2,),
    rate_hz: float = 30.0,
    planning_hz: float | None = None,
    seconds: float = 60.0,
    on_turn: Callable[[str, int], None] | None = None,
) -> FlightBenchmark:
    """Fly `program` with each of `files` (label -> model file) and each number of threads, one after the other.

    Args:
        task: one of TASKS. size: (width, height) of frames and network.
        rate_hz: of the camera; planning_hz: task.planning_rate_hz, by default the same.
        seconds: how long each flies, from the pilot's switch on. Memory counts after a fifth of it, 60 s at most.
        on_turn: called with (label, threads) before each flight.

    Raises:
        ValueError: an unknown task, or a rate or time that is not positive.
        RuntimeError: the program did not start or ended by itself; with what it said.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task '{task}'; known are {', '.join(TASKS)}.")
    if not (0 < rate_hz <= 1000 and seconds > 0):
        raise ValueError(f"{rate_hz:g} Hz for {seconds:g} s: give a rate above 0 up to 1000 and a time above 0.")
    machine = describe_machine()  # before the load average counts this run
    pictures = _pictures(*size)
    rows = []
    for label, file in files.items():
        for count in threads:
            if on_turn is not None:
                on_turn(label, count)
            settings = {"threads": count, "width": size[0], "height": size[1], "task": task}
            settings["planning"] = planning_hz or rate_hz
            rows.append(_fly(program, label, file, settings, pictures, rate_hz, seconds))
    return FlightBenchmark(
        rows=tuple(rows),
        task=task,
        size=size,
        rate_hz=rate_hz,
        machine=machine,
        load_average_after=round(os.getloadavg()[0], 2),
        nice=os.nice(0),
        versions=describe_versions(("pymavlink",)),
    )


def _fly(
    program: Path,
    label: str,
    file: Path,
    settings: dict[str, Any],
    pictures: list[NDArray[np.uint8]],
    rate_hz: float,
    seconds: float,
) -> Row:
    from ajna.mavlink_vehicle import MavlinkVehicle

    with tempfile.TemporaryDirectory(prefix="ajna-flight-", dir=memory_folder()) as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        vehicle = MavlinkVehicle()
        vehicle.attitude_every_s = None
        config = folder / "flight.yaml"
        config.write_text(
            _CONFIG.format(
                model=file.resolve(), frames=folder / "frames", port=vehicle.port, log=folder / "log", **settings
            )
        )
        said = folder / "said.txt"
        with said.open("w") as output:
            process = subprocess.Popen([str(program), "--config", str(config)], stdout=output, stderr=output)
        try:
            seen = _Watch(process, said, vehicle, SpoolFolder(folder / "frames"), pictures, rate_hz)
            seen.fly(seconds)
            process.terminate()
            process.wait(30)
        finally:
            process.kill()
            process.wait()
            vehicle.close()
        logs = list((folder / "log").glob("*.jsonl"))
        end = read_log(logs[0]).end if logs else {}
        if not end:
            raise RuntimeError(f"the flight program left no whole log; it said:\n{said.read_text()}")
    return Row(
        label=label,
        file=file.name,
        threads=settings["threads"],
        seconds=seen.flown_s,
        frames_sent=seen.sent,
        **{key: int(end[key]) for key in ("frames", "dropped", "stale", "damaged", "network_failures")},
        activations=int(end["activations"]),
        commands_sent=int(end["commands_sent"]),
        commanding=seen.commanding,
        p50_ms=end["latency_p50_ms"],
        p95_ms=end["latency_p95_ms"],
        p99_ms=end["latency_p99_ms"],
        max_ms=end["latency_max_ms"],
        cpu_cores=seen.cpu_cores,
        memory=seen.memory(seconds),
    )


class _Watch:
    """Camera, pilot and observer of one flight."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        said: Path,
        vehicle: Any,
        camera: SpoolFolder,
        pictures: list[NDArray[np.uint8]],
        rate_hz: float,
    ) -> None:
        self._process, self._said, self._vehicle = process, said, vehicle
        self._camera, self._pictures, self._rate_hz = camera, pictures, rate_hz
        self.sent = 0
        self._resident: list[tuple[float, int]] = []  # (seconds since the switch, bytes)
        self._overridden: list[bool] = []
        self.flown_s = self.cpu_cores = 0.0

    @property
    def commanding(self) -> float:
        """Share of the samples in which the sticks were overridden."""
        return float(np.mean(self._overridden)) if self._overridden else 0.0

    def memory(self, seconds: float) -> Memory:
        """Of the samples after the settling time."""
        settle = min(SETTLE_SHARE * seconds, SETTLE_MAX_S)
        samples = [sample for sample in self._resident if sample[0] >= settle] or self._resident[-1:]
        times, sizes = np.array(samples, dtype=float).T
        growth = float(np.polyfit(times, sizes, 1)[0]) * 3600 if len(samples) > 2 else 0.0
        return Memory(int(sizes[0]), int(sizes[-1]), int(sizes.max()), growth)

    def fly(self, seconds: float) -> None:
        """Until the program is ready, and then so long; the switch goes off and on where it has released."""
        for elapsed in self._frames():
            if is_ready(self._said.read_text()):
                break
            if elapsed > _START_S:
                raise RuntimeError(f"the flight program did not become ready; it said:\n{self._said.read_text()}")
        self._vehicle.switch_us = 2000
        began_cpu, next_look, on_since = self._cpu_s(), 1.0, 0.0
        for elapsed in self._frames():
            self.flown_s = elapsed
            if elapsed >= seconds:
                break
            if elapsed < next_look:
                continue
            next_look += 1.0
            overridden = self._vehicle.overridden
            self._resident.append((elapsed, self._resident_bytes()))
            self._overridden.append(overridden)
            if self._vehicle.switch_us < 1500:
                self._vehicle.switch_us, on_since = 2000, elapsed
            elif not overridden and elapsed - on_since > 1.5:
                self._vehicle.switch_us = 1000  # released: the pilot begins anew
        self.cpu_cores = (self._cpu_s() - began_cpu) / max(self.flown_s, 1e-9)

    def _frames(self) -> Iterator[float]:
        """Deliver a frame per interval; the seconds since the first."""
        began = time.monotonic()
        for index in range(1 << 62):
            due = began + index / self._rate_hz
            time.sleep(max(0.0, due - time.monotonic()))
            if self._process.poll() is not None:
                raise RuntimeError(f"the flight program has ended; it said:\n{self._said.read_text()}")
            self._vehicle.send_motion(time.monotonic(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (_FORWARD_M_S, 0.0, 0.0))
            self._camera.put(self.sent, self._pictures[self.sent % len(self._pictures)])
            self.sent += 1
            yield time.monotonic() - began

    def _resident_bytes(self) -> int:
        pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")

    def _cpu_s(self) -> float:
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _pictures(width: int, height: int) -> list[NDArray[np.uint8]]:
    """Windows that wander on a circle over one rendered picture, RGB uint8 [height, width, 3]."""
    from ajna.data.synthetic import SyntheticScenes

    whole = SyntheticScenes(1, 2 * width, 2 * height, seed=78, scene={"bank_size": 8}).read(0).frame1
    turn = np.arange(_ROUND) * (2 * np.pi / _ROUND)
    radius = min(width, height) / 4
    left = (width / 2 + radius * np.cos(turn)).round().astype(int)
    top = (height / 2 + radius * np.sin(turn)).round().astype(int)
    return [np.ascontiguousarray(whole[y : y + height, x : x + width]) for x, y in zip(left, top, strict=True)]


def _cells(row: Row) -> list[str]:
    memory = row.memory
    return [
        row.label,
        str(row.threads),
        *(f"{value:.0f}" for value in (row.p50_ms, row.p95_ms, row.p99_ms, row.max_ms)),
        f"{row.looked_at / max(row.frames_sent, 1):.0%}",
        f"{row.cpu_cores:.2f}",
        f"{row.commanding:.1%}",
        str(row.activations),
        *(f"{size / 1e6:.1f}" for size in (memory.settled, memory.end, memory.largest)),
        f"{memory.growth_per_h / 1e6:+.2f}",
    ]
