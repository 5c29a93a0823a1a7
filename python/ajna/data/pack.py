# SPDX-License-Identifier: MIT
"""Packing a data set: every sample decoded once, written in chunks that a kill cannot damage."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ajna import io
from ajna.data.dataset import BAD_SAMPLE_ERRORS, FlowDataset
from ajna.data.pack_format import FORMAT, VERSION, chunk_path, common_parts, layout, read_json, write_json
from ajna.data.packed import read_info

_PROBED = 16  # samples whose size is looked at for an estimate of a pack in native size
_MARGIN = 64 << 20  # bytes of disk to leave free


@dataclass(frozen=True)
class Estimate:
    """What a pack takes.

    Attributes:
        samples: how many.
        bytes: of all records; exact for a given size, else from the mean over some samples.
        parts: what is packed beside the frames.
        left_out: what is not packed, because only some of the samples have it.
    """

    samples: int
    bytes: int
    parts: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass
class PackReport:
    """What packing did.

    Attributes:
        samples, bytes: in the pack.
        bad: case -> why it was left out.
        resumed: samples that an earlier run had packed already.
    """

    samples: int = 0
    bytes: int = 0
    bad: dict[str, str] = field(default_factory=dict)
    resumed: int = 0


def estimate(dataset: FlowDataset, size: tuple[int, int] | None = None) -> Estimate:
    """The size of a pack of this data set, (width, height) or native.

    Raises:
        ValueError: the data set has no ground truth, or none of the probed samples can be read.
    """
    usable = [index for index in range(len(dataset)) if dataset.names[index] not in dataset.bad]
    if not usable:
        raise dataset.none_left()
    parts, left_out = common_parts([dataset.parts(index) for index in usable])
    if "flow" not in parts:
        raise ValueError(f"'{dataset.root}' has samples without ground truth: nothing to learn from; pack others.")
    if size is not None:
        return Estimate(len(dataset), len(usable) * layout(*size, parts).bytes, parts, left_out)
    lengths, problem = [], ""
    for place in np.unique(np.linspace(0, len(usable) - 1, _PROBED).astype(int)):
        try:
            height, width = io.read_image(dataset.files(usable[place])[0]).shape[:2]
        except BAD_SAMPLE_ERRORS as error:  # packing will say which, or skip it
            problem = str(error)
            continue
        lengths.append(layout(width, height, parts).bytes)
    if not lengths:
        raise ValueError(problem)
    return Estimate(len(dataset), round(len(usable) * sum(lengths) / len(lengths)), parts, left_out)


def pack(
    dataset: FlowDataset,
    out: str | Path,
    *,
    source: Mapping[str, Any] | None = None,
    size: tuple[int, int] | None = None,
    chunk_samples: int = 64,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> PackReport:
    """Pack a data set into a folder; called again after a kill it goes on with the first chunk that is not complete.

    The bytes depend on the data and these options only, not on the workers or on interruptions. A chunk whose source
    files changed in size since is packed anew.

    Args:
        dataset: what to pack; with its `skip_bad`, bad samples are left out and listed, else the first one raises.
        out: a new or empty folder, or one with the same pack, finished or not.
        source: name and options of the data set, kept in pack.json; a resumed pack must have the same.
        size: (width, height) of the packed pairs; None packs each in its own.
        chunk_samples: samples per file: what a kill loses at most.
        workers: threads that decode; by default one per CPU, at most 16.
        on_progress: called with (samples done, all samples).

    Raises:
        ValueError: a bad sample, a folder that holds something else, a data set without ground truth.
        RuntimeError: not enough space on the disk, or another process packs into the folder.
    """
    out = Path(out)
    if chunk_samples < 1:
        raise ValueError(f"chunk_samples={chunk_samples} makes no chunk; give 1 or more.")
    expected = estimate(dataset, size)
    plan = {
        "format": FORMAT,
        "version": VERSION,
        "source": dict(source or {}),
        "size": list(size) if size else None,
        "parts": list(expected.parts),
        "chunk_samples": chunk_samples,
        "samples": len(dataset),
    }
    out.mkdir(parents=True, exist_ok=True)
    with _lock(out):
        _check_folder(out, plan)
        packer = _Packer(dataset, out, size, expected.parts, chunk_samples)
        finished = packer.finished()
        _check_space(out, expected, sum(index["bytes"] for index in finished.values()))
        if not (out / "pack.json").is_file() or len(finished) < packer.chunks:
            write_json(out / "pack.json", {**plan, "complete": False, "chunks": []})
        report = packer.run(finished, workers or min(16, os.cpu_count() or 1), on_progress)
        hashes = [read_json(chunk_path(out, chunk, ".json"))[1] for chunk in range(packer.chunks)]
        if report.samples == 0:
            first = next(iter(report.bad.values()))
            raise ValueError(f"no sample of '{dataset.root}' can be packed; the first: {first}")
        write_json(out / "pack.json", {**plan, "complete": True, "chunks": hashes})
    return report


class _Packer:
    def __init__(
        self, dataset: FlowDataset, out: Path, size: tuple[int, int] | None, parts: tuple[str, ...], chunk_samples: int
    ) -> None:
        self.dataset, self.out, self.size, self.parts, self.step = dataset, out, size, parts, chunk_samples
        self.chunks = -(-len(dataset) // chunk_samples)

    def indices(self, chunk: int) -> range:
        return range(chunk * self.step, min((chunk + 1) * self.step, len(self.dataset)))

    def fingerprint(self, chunk: int) -> str:
        """Of the names and the lengths of the source files: what a resumed pack compares."""
        digest = hashlib.sha256()
        for index in self.indices(chunk):
            lengths = []
            for path in self.dataset.files(index):
                try:
                    lengths.append(path.stat().st_size)
                except OSError:
                    lengths.append(-1)
            digest.update(repr((self.dataset.names[index], lengths)).encode())
        return digest.hexdigest()

    def finished(self) -> dict[int, dict[str, Any]]:
        """Chunk -> index of the chunks that are complete and still fit their source."""
        found = {}
        for chunk in range(self.chunks):
            try:
                index, _ = read_json(chunk_path(self.out, chunk, ".json"))
                length = chunk_path(self.out, chunk, ".bin").stat().st_size
            except (FileNotFoundError, ValueError):
                continue
            same = index.get("fingerprint") == self.fingerprint(chunk) and length == index.get("bytes")
            if same and (self.dataset.skip_bad or not index.get("bad")):
                found[chunk] = index
        return found

    def run(
        self, finished: Mapping[int, dict[str, Any]], workers: int, on_progress: Callable[[int, int], None] | None
    ) -> PackReport:
        for leftover in self.out.glob("*.tmp"):  # of a killed run
            leftover.unlink()
        report = PackReport()
        done = 0
        with ThreadPoolExecutor(workers) as pool:
            for chunk in range(self.chunks):
                if chunk in finished:
                    index = finished[chunk]
                    report.resumed += len(index["records"])
                else:

                    def tick(number: int, start: int = done) -> None:
                        if on_progress is not None:
                            on_progress(start + number, len(self.dataset))

                    index = self._write(chunk, pool, workers, tick)
                done += len(self.indices(chunk))
                report.samples += len(index["records"])
                report.bytes += index["bytes"]
                report.bad |= index["bad"]
                if on_progress is not None:
                    on_progress(done, len(self.dataset))
        return report

    def _write(self, chunk: int, pool: ThreadPoolExecutor, workers: int, tick: Callable[[int], None]) -> dict[str, Any]:
        """Write one chunk: first the records, then the index that makes them count."""
        path = chunk_path(self.out, chunk, ".bin")
        chunk_path(self.out, chunk, ".json").unlink(missing_ok=True)
        fingerprint = self.fingerprint(chunk)
        temporary = path.with_name(path.name + ".tmp")
        records: list[dict[str, Any]] = []
        bad: dict[str, str] = {}
        digest, offset = hashlib.sha256(), 0
        try:
            with open(temporary, "wb") as file:
                for number, (index, made) in enumerate(self._records(self.indices(chunk), pool, workers), 1):
                    name = self.dataset.names[index]
                    if isinstance(made, str):
                        bad[name] = made
                    else:
                        (width, height), record = made
                        file.write(record.data)
                        digest.update(record.data)
                        records.append(
                            {
                                "name": name,
                                "width": width,
                                "height": height,
                                "offset": offset,
                                "crc32": zlib.crc32(record.data),
                            }
                        )
                        offset += len(record)
                    tick(number)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
            content = {
                "chunk": chunk,
                "bytes": offset,
                "sha256": digest.hexdigest(),
                "fingerprint": fingerprint,
                "records": records,
                "bad": bad,
            }
            write_json(chunk_path(self.out, chunk, ".json"), content)
        except BaseException as error:
            temporary.unlink(missing_ok=True)
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise RuntimeError(
                    f"the disk of '{self.out}' is full after {chunk} of {self.chunks} chunks; "
                    "make room and run the same command again, which goes on from there."
                ) from None
            raise
        return content

    def _records(
        self, indices: Sequence[int], pool: ThreadPoolExecutor, workers: int
    ) -> Iterator[tuple[int, str | tuple[tuple[int, int], NDArray[np.uint8]]]]:
        """In order, read ahead by a few samples per worker only: a chunk of large frames need not fit the memory."""
        waiting: deque[tuple[int, Future[str | tuple[tuple[int, int], NDArray[np.uint8]]]]] = deque()
        try:
            for index in indices:
                waiting.append((index, pool.submit(self._record, index)))
                if len(waiting) > 2 * workers:
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            for _, future in waiting:
                future.cancel()

    def _record(self, index: int) -> str | tuple[tuple[int, int], NDArray[np.uint8]]:
        """(size, record), or why the sample is left out."""
        name = self.dataset.names[index]
        if name in self.dataset.bad:
            return self.dataset.bad[name]
        try:
            pair = self.dataset.read(index)
        except BAD_SAMPLE_ERRORS as error:
            if not self.dataset.skip_bad:
                raise
            return str(error)
        if self.size is not None:
            pair = pair.resized(*self.size)
        return pair.size, layout(*pair.size, self.parts).encode(pair)


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Held until the process ends, however it ends."""
    with open(out / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RuntimeError(f"another process packs into '{out}'; wait for it or choose another folder.") from None
        yield


def _check_folder(out: Path, plan: Mapping[str, Any]) -> None:
    if not (out / "pack.json").is_file():
        foreign = sorted(path.name for path in out.iterdir() if path.name not in (".lock", "pack.json.tmp"))
        if foreign:
            raise ValueError(f"folder '{out}' holds '{foreign[0]}' but no pack; choose a new or an empty folder.")
        return
    before = read_info(out)
    for key, wanted in plan.items():
        if before.get(key) != wanted:
            raise ValueError(
                f"folder '{out}' holds a pack with {key} {before.get(key)}, not {wanted}; "
                "choose another folder, or delete this one."
            )


def _check_space(out: Path, expected: Estimate, present: int) -> None:
    needed, free = expected.bytes - present, shutil.disk_usage(out).free
    if needed > 0 and needed + _MARGIN > free:
        raise RuntimeError(
            f"the pack needs {needed / 2**30:.1f} GiB more, but '{out}' has {free / 2**30:.1f} GiB free; "
            "make room, choose another disk, or pack a smaller size."
        )
