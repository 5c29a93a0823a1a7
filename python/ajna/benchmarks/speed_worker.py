# SPDX-License-Identifier: MIT
"""One format in a process of its own, started by `ajna.benchmarks.speed`: prints its times and its memory as JSON.

It is run as a file, not as a module, so that nothing of Ajna (and no torch) counts into the memory of a format that
does without.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

MIN_RUNS = 3
WARM_UP_RUNS = 5


def peak_bytes() -> int:
    """Largest resident set of this process so far.

    Not ru_maxrss: that one begins with what the parent held when it started this process.
    """
    match = re.search(r"^VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(match[1]) * 1024 if match else 0


def measure(call: Callable[[], Any], seconds: float, max_runs: int) -> list[float]:
    """Milliseconds of each call, after calls that do not count (at most half of `seconds`), for about `seconds`."""
    start = time.perf_counter()
    for _ in range(WARM_UP_RUNS):
        call()
        if time.perf_counter() - start > seconds / 2:
            break
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < max_runs and (len(times) < MIN_RUNS or time.perf_counter() - begin < seconds):
        start = time.perf_counter()
        call()
        times.append(1000 * (time.perf_counter() - start))
    return times


def _frames(width: int, height: int) -> tuple[Any, Any]:
    import numpy as np

    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    return frames[0], frames[1]


def _exported(args: argparse.Namespace) -> Callable[[], Any]:
    spec = importlib.util.spec_from_file_location("runners", args.runners)
    assert spec is not None and spec.loader is not None
    runners = importlib.util.module_from_spec(spec)
    sys.modules["runners"] = runners
    spec.loader.exec_module(runners)
    runner = runners.open_exported(args.kind, Path(args.file), args.threads)
    first, second = _frames(args.width, args.height)
    return lambda: runner.predict(first, second)


def _engine(args: argparse.Namespace) -> Callable[[], Any]:
    import ajna

    model = ajna.load(args.file, threads=args.threads)
    first, second = _frames(args.width, args.height)
    return lambda: model(first, second)


def _matrix_product(args: argparse.Namespace) -> Callable[[], Any]:
    import torch

    torch.set_num_threads(args.threads)
    a, b, c = (torch.rand(args.side, args.side) for _ in range(3))
    return lambda: torch.mm(a, b, out=c)


def main() -> None:
    """Measure what the arguments say and print {"times_ms": [...], "peak_bytes": ...}."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", required=True)
    parser.add_argument("--file")
    parser.add_argument("--runners")
    for name in ("width", "height", "threads", "side"):
        parser.add_argument(f"--{name}", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--max-runs", type=int, default=1000)
    args = parser.parse_args()
    del sys.path[0]  # this file's folder: its neighbours are no packages
    kinds = {"engine": _engine, "matrix-product": _matrix_product}
    call = kinds.get(args.kind, _exported)(args)
    times = measure(call, args.seconds, args.max_runs)
    print(json.dumps({"times_ms": times, "peak_bytes": peak_bytes()}))


if __name__ == "__main__":
    main()
