# SPDX-License-Identifier: MIT
"""The files of a pack: how a sample lies in a record, and the two kinds of JSON files beside the records.

A pack is a folder::

    pack.json           what was packed and how; "complete" once every chunk is there
    chunk-00000.bin     records, one after the other, each a multiple of 64 bytes
    chunk-00000.json    the records' names, sizes, offsets and checksums

A record holds frame1, frame2 (uint8 [H, W, 3]), and what the data set has of flow (float16 [H, W, 2], little endian),
valid, occlusion, motion_boundary (one bit a pixel, row by row, the first in the highest bit), and the same with the
prefix backward_. Every field begins at a multiple of 64 bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ajna.data.frame_pair import FramePair, Truth

FORMAT, VERSION = "ajna-pack", 1
PARTS = (
    "flow",
    "occlusion",
    "motion_boundary",
    "backward_flow",
    "backward_occlusion",
    "backward_motion_boundary",
)
FLOAT16_MAX = 65504.0
_ALIGN = 64


@dataclass(frozen=True)
class Field:
    """One array of a record: where it lies and what it is (u8, f16 or bits)."""

    name: str
    kind: str
    offset: int
    bytes: int
    channels: int


@dataclass(frozen=True)
class Layout:
    """The fields of a record of one size.

    Attributes:
        fields: in order.
        bytes: length of a record.
    """

    width: int
    height: int
    fields: tuple[Field, ...]
    bytes: int

    def encode(self, pair: FramePair) -> NDArray[np.uint8]:
        """A pair of this size as a record. Vectors that float16 cannot hold become not valid."""
        record = np.zeros(self.bytes, np.uint8)
        arrays = _arrays(pair)
        for item in self.fields:
            array = arrays[item.name]
            if item.kind == "bits":
                array = np.packbits(array)
            elif item.kind == "f16":
                array = np.ascontiguousarray(array, "<f2").view(np.uint8)
            record[item.offset : item.offset + item.bytes] = array.reshape(-1)
        return record

    def decode(self, record: NDArray[np.uint8], name: str) -> FramePair:
        """A record as a pair with arrays of its own."""
        shape = (self.height, self.width)
        arrays: dict[str, NDArray[Any]] = {}
        for item in self.fields:
            raw = record[item.offset : item.offset + item.bytes]
            if item.kind == "bits":
                bits = np.unpackbits(raw, count=self.height * self.width)
                arrays[item.name] = bits.view(np.bool_).reshape(shape)
            elif item.kind == "f16":
                arrays[item.name] = raw.view("<f2").reshape(*shape, 2).astype(np.float32)
            else:
                arrays[item.name] = np.array(raw).reshape(*shape, 3)
        backward = None
        if "backward_flow" in arrays:
            backward = Truth(
                arrays["backward_flow"],
                arrays["backward_valid"],
                arrays.get("backward_occlusion"),
                arrays.get("backward_motion_boundary"),
            )
        return FramePair(
            name,
            arrays["frame1"],
            arrays["frame2"],
            arrays["flow"],
            arrays["valid"],
            arrays.get("occlusion"),
            arrays.get("motion_boundary"),
            backward,
        )

    def decode_batch(self, records: Tensor) -> dict[str, Tensor]:
        """Records uint8 [B, bytes] as tensors on the same device.

        Frames are uint8 [B, 3, H, W] (views into the records, channels last), flow is float32 [B, 2, H, W], masks are
        bool [B, 1, H, W].
        """
        batch, pixels = records.shape[0], self.height * self.width
        made: dict[str, Tensor] = {}
        for item in self.fields:
            raw = records[:, item.offset : item.offset + item.bytes]
            if item.kind == "bits":
                places = torch.arange(7, -1, -1, dtype=torch.uint8, device=records.device)
                bits = (raw[..., None] >> places) & 1
                mask = bits.reshape(batch, -1)[:, :pixels].bool()
                made[item.name] = mask.reshape(batch, 1, self.height, self.width)
                continue
            values = raw.view(torch.float16).float() if item.kind == "f16" else raw
            image = values.reshape(batch, self.height, self.width, item.channels)
            made[item.name] = image.permute(0, 3, 1, 2)
        return made


def _arrays(pair: FramePair) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"frame1": pair.frame1, "frame2": pair.frame2}
    for prefix, truth in (("", pair.truth), ("backward_", pair.backward)):
        if truth is not None:
            valid = truth.valid & (np.abs(truth.flow) <= FLOAT16_MAX).all(axis=-1)
            arrays[f"{prefix}flow"] = np.where(valid[..., None], truth.flow, np.float32(0))
            arrays[f"{prefix}valid"] = valid
            for name in ("occlusion", "motion_boundary"):
                if (mask := getattr(truth, name)) is not None:
                    arrays[f"{prefix}{name}"] = mask
    return arrays


@lru_cache(maxsize=256)
def layout(width: int, height: int, parts: tuple[str, ...]) -> Layout:
    """The layout of records of one size with these parts (of `PARTS`)."""
    kinds = [("frame1", "u8", 3), ("frame2", "u8", 3)]
    for part in parts:
        if part.endswith("flow"):
            kinds += [(part, "f16", 2), (part.replace("flow", "valid"), "bits", 1)]
        else:
            kinds.append((part, "bits", 1))
    fields, offset, pixels = [], 0, width * height
    for name, kind, channels in kinds:
        size = {"u8": 3 * pixels, "f16": 4 * pixels, "bits": math.ceil(pixels / 8)}[kind]
        fields.append(Field(name, kind, offset, size, channels))
        offset = math.ceil((offset + size) / _ALIGN) * _ALIGN
    return Layout(width, height, tuple(fields), offset)


def common_parts(parts: Sequence[frozenset[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(what all samples have, what only some have), both in the order of `PARTS`."""
    every, some = frozenset.intersection(*parts), frozenset.union(*parts)
    return tuple(p for p in PARTS if p in every), tuple(p for p in PARTS if p in some - every)


# --- JSON files ----------------------------------------------------------------------------------------------------


def chunk_path(root: Path, chunk: int, suffix: str) -> Path:
    """`suffix`: .bin or .json."""
    return root / f"chunk-{chunk:05d}{suffix}"


def write_json(path: Path, value: dict[str, Any]) -> str:
    """Write atomically; returns the file's SHA-256."""
    data = (json.dumps(value, indent=1) + "\n").encode()
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    return hashlib.sha256(data).hexdigest()


def read_json(path: Path) -> tuple[dict[str, Any], str]:
    """(content, SHA-256).

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is not a JSON object.
    """
    data = path.read_bytes()
    try:
        value = json.loads(data)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise ValueError(f"file '{path}' is damaged (it is not a JSON object).")
    return value, hashlib.sha256(data).hexdigest()
