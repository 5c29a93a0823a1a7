# SPDX-License-Identifier: MIT
"""Reading packs: samples and batches without a decode, from memory-mapped files or from the device's memory."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ajna.data.dataset import FlowDataset, check_names, limited
from ajna.data.frame_pair import FramePair
from ajna.data.pack_format import FORMAT, VERSION, Layout, chunk_path, layout, read_json


@dataclass(frozen=True)
class _Record:
    chunk: int
    offset: int
    width: int
    height: int
    crc32: int


class PackedDataset(FlowDataset):
    """A pack made by ``train/pack.py``: the same pairs, with flow rounded to float16.

    A record's checksum is compared when the record is first read; `verify` compares everything at once.

    Args:
        root: the pack's folder.
        cases: only these (and in this order); by default all.
        skip_bad, max_flow: see FlowDataset.

    Attributes:
        info: the content of pack.json.
        packed_bad: case -> why it was left out when the pack was made.

    Raises:
        FileNotFoundError: no pack there.
        ValueError: an unfinished, damaged or too new pack; an unknown case.
    """

    title = "pack"

    def __init__(
        self,
        root: str | Path,
        cases: Sequence[str] = (),
        skip_bad: bool = False,
        max_flow: float | None = None,
    ) -> None:
        folder = Path(root)
        self.info = read_info(folder)
        if not self.info["complete"]:
            raise ValueError(f"pack '{root}' is unfinished; run the same packing command again to finish it.")
        self.packed_bad: dict[str, str] = {}
        self._parts = tuple(str(part) for part in self.info["parts"])
        self._hashes: list[str] = []
        records: dict[str, _Record] = {}
        for chunk, index_hash in enumerate(self.info["chunks"]):
            index = _read_index(folder, chunk, index_hash)
            self._hashes.append(index["sha256"])
            self.packed_bad |= index["bad"]
            records |= {
                item["name"]: _Record(chunk, item["offset"], item["width"], item["height"], item["crc32"])
                for item in index["records"]
            }
        check_names(cases, records, root)
        names = tuple(cases or records)
        self._records = [records[name] for name in names]
        self._checked = np.zeros(len(names), bool)
        self._maps: dict[int, NDArray[np.uint8]] = {}
        super().__init__(root, names, skip_bad, max_flow)

    def __getstate__(self) -> dict[str, Any]:
        # A map would be pickled with its content; each process opens its own.
        return {**self.__dict__, "_maps": {}}

    def files(self, index: int) -> list[Path]:
        return [chunk_path(self.root, self._records[index].chunk, ".bin")]

    def parts(self, index: int) -> frozenset[str]:
        return frozenset(self._parts)

    @property
    def bytes(self) -> int:
        """Length of all records."""
        return sum(self._layout(record).bytes for record in self._records)

    @property
    def size(self) -> tuple[int, int] | None:
        """(width, height) of all pairs, None if they differ."""
        sizes = {(record.width, record.height) for record in self._records}
        return sizes.pop() if len(sizes) == 1 else None

    def _layout(self, record: _Record) -> Layout:
        return layout(record.width, record.height, self._parts)

    def checksum(self, index: int) -> int:
        """CRC-32 of a sample's record, as it was written."""
        return self._records[index].crc32

    def record(self, index: int) -> NDArray[np.uint8]:
        """The bytes of a sample: a read-only view of the file.

        Raises:
            ValueError: they do not have the checksum that they were written with.
        """
        item = self._records[index]
        if item.chunk not in self._maps:
            path = chunk_path(self.root, item.chunk, ".bin")
            self._maps[item.chunk] = np.memmap(path, np.uint8, mode="r").view(np.ndarray)
        view = self._maps[item.chunk][item.offset : item.offset + self._layout(item).bytes]
        if not self._checked[index]:
            if zlib.crc32(view.data) != item.crc32:
                raise _damaged(self.root, item.chunk, f"case '{self.names[index]}' has another checksum")
            self._checked[index] = True
        return view

    def read(self, index: int) -> FramePair:
        item = self._records[index]
        pair = self._layout(item).decode(self.record(index), self.names[index])
        if self.max_flow is None or pair.truth is None:
            return pair
        truth = limited(pair.truth, self.max_flow)
        backward = None if pair.backward is None else limited(pair.backward, self.max_flow)
        return replace(pair, flow=truth.flow, valid=truth.valid, backward=backward)

    def batch(self, indices: Iterable[int], device: str | torch.device = "cpu") -> dict[str, Tensor]:
        """Several samples as tensors, moved in one piece and taken apart on the device.

        Returns:
            frame1, frame2: uint8 [B, 3, H, W] (channels last); flow: float32 [B, 2, H, W]; valid and what else there
            is: bool [B, 1, H, W].

        Raises:
            ValueError: pairs of several sizes, no index, or a damaged record.
        """
        chosen, form = list(indices), self._one_layout()
        if not chosen:
            raise ValueError("a batch of no samples was asked for; give at least one index.")
        device = torch.device(device)
        rows = torch.empty(len(chosen), form.bytes, dtype=torch.uint8, pin_memory=device.type == "cuda")
        view = rows.numpy()
        for row, index in enumerate(chosen):
            view[row] = self.record(index)
        return self._finish(form.decode_batch(rows.to(device, non_blocking=True)))

    def resident(
        self, device: str | torch.device, on_progress: Callable[[int, int], None] | None = None
    ) -> ResidentPack:
        """The whole pack in the device's memory: see `bytes` for what that takes."""
        form = self._one_layout()
        records = torch.empty(len(self), form.bytes, dtype=torch.uint8, device=device)
        step = max(1, (64 << 20) // form.bytes)
        for start in range(0, len(self), step):
            stop = min(start + step, len(self))
            rows = np.stack([self.record(index) for index in range(start, stop)])
            records[start:stop] = torch.from_numpy(rows)
            if on_progress is not None:
                on_progress(stop, len(self))
        return ResidentPack(self, form, records)

    def _one_layout(self) -> Layout:
        if self.size is None:
            raise ValueError(
                f"pack '{self.root}' holds pairs of several sizes, which make no batch; pack it with a size."
            )
        return layout(*self.size, self._parts)

    def _finish(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        if self.max_flow is not None:
            for prefix in ("", "backward_"):
                if (flow := batch.get(f"{prefix}flow")) is not None:
                    valid = batch[f"{prefix}valid"] & (flow.abs() <= self.max_flow).all(dim=1, keepdim=True)
                    batch[f"{prefix}valid"], batch[f"{prefix}flow"] = valid, flow * valid
        return batch

    def verify(self, on_progress: Callable[[int, int], None] | None = None) -> None:
        """Compare the checksums of all chunks.

        Raises:
            ValueError: the first chunk that is damaged.
        """
        for chunk, expected in enumerate(self._hashes):
            with open(chunk_path(self.root, chunk, ".bin"), "rb") as file:
                digest = hashlib.sha256()
                while block := file.read(1 << 22):
                    digest.update(block)
            if digest.hexdigest() != expected:
                raise _damaged(self.root, chunk, "its content has another checksum")
            if on_progress is not None:
                on_progress(chunk + 1, len(self._hashes))


class ResidentPack:
    """A pack in the memory of a device.

    Attributes:
        records: uint8 [N, bytes of a record].
    """

    def __init__(self, dataset: PackedDataset, form: Layout, records: Tensor) -> None:
        self.names, self.records = dataset.names, records
        self._dataset, self._form = dataset, form

    def __len__(self) -> int:
        return self.records.shape[0]

    def batch(self, indices: Tensor | Sequence[int]) -> dict[str, Tensor]:
        """As `PackedDataset.batch`; nothing is moved but the indices."""
        chosen = torch.as_tensor(indices, device=self.records.device)
        return self._dataset._finish(self._form.decode_batch(self.records[chosen]))


def read_info(root: Path) -> dict[str, Any]:
    """The content of pack.json, checked.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of another version.
    """
    path = root / "pack.json"
    if not path.is_file():
        raise FileNotFoundError(f"'{root}' holds no pack (no pack.json); make one with train/pack.py.")
    info, _ = read_json(path)
    if info.get("format") != FORMAT:
        raise ValueError(f"file '{path}' does not describe a pack of ajna; give a folder made by train/pack.py.")
    if info.get("version") != VERSION:
        raise ValueError(
            f"pack '{root}' has version {info.get('version')}, this ajna reads version {VERSION}; pack the data again."
        )
    lacking = [key for key in ("complete", "parts", "chunks", "size", "samples", "chunk_samples") if key not in info]
    if lacking:
        raise ValueError(f"file '{path}' is damaged (it lacks '{lacking[0]}'); delete the folder and pack again.")
    return info


def _damaged(root: Path, chunk: int, what: str) -> ValueError:
    name = chunk_path(root, chunk, ".bin").name
    index = chunk_path(root, chunk, ".json").name
    return ValueError(
        f"pack '{root}' is damaged in '{name}' ({what}); delete '{index}' and run the packing command again, "
        "which packs this chunk anew."
    )


def _read_index(root: Path, chunk: int, expected: str) -> dict[str, Any]:
    try:
        index, digest = read_json(chunk_path(root, chunk, ".json"))
    except (FileNotFoundError, ValueError):
        raise _damaged(root, chunk, "its index is missing or damaged") from None
    if digest != expected:
        raise _damaged(root, chunk, "its index has another checksum")
    try:
        length = chunk_path(root, chunk, ".bin").stat().st_size
    except FileNotFoundError:
        raise _damaged(root, chunk, "the file is missing") from None
    if length != index["bytes"]:
        raise _damaged(root, chunk, f"it has {length} bytes instead of {index['bytes']}")
    return index
